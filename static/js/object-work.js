// What is being done for the objects, where they are: fetching, or making one of a mesh; and what went wrong.
import { byId } from "./dom.js";
import { LIVE, controls, stateText, titleText } from "./jobs.js";
import { nextStep, stepKey } from "./next-step.js";
import { massText, refreshObjects, sizeText } from "./objects.js";
import { clearMesh } from "./own-object.js";
import { inWords, known, watch } from "./state.js";

let followed = ""; // the job that was seen at work, whose end is told, too
let drawn = "";

function endText(job) {
  if (job.state !== "done" || job.kind !== "add_object") return stateText(job);
  const { size_m: size, mass_kg: mass } = job.result;
  const guessed = job.params.object.mass_kg === null ? ", guessed from its volume" : "";
  return `Ready: ${sizeText(size)}, ${massText(mass)}${guessed}. It can be pushed at once; to be recognised, it needs a field.`;
}

function settle(job) {
  if (job.state !== "done") return;
  refreshObjects();
  if (job.kind === "add_object") clearMesh(job.params.file_name);
}

function draw(job) {
  const isLive = job && LIVE.has(job.state);
  if (isLive) followed = job.id;
  byId("object-work").hidden = !job || followed !== job.id;
  if (!job || followed !== job.id) return;
  byId("object-work-title").textContent = titleText(job);
  byId("object-work-bar").hidden = !isLive;
  byId("object-work-bar").value = job.total ? job.done / job.total : 0;
  byId("object-work-state").textContent = endText(job);
  byId("object-work-error").textContent = inWords(job.error ?? "");
  byId("object-work-error").hidden = !job.error;
  const isNew = job.state === "done" && job.kind === "add_object";
  const key = `${job.id} ${job.state}${isNew ? stepKey(job.params.name) : ""}`;
  if (drawn === key) return;
  const isSettled = drawn.startsWith(`${job.id} ${job.state}`);
  byId("object-work-actions").replaceChildren(...(isNew ? [nextStep(job.params.name)] : []), ...controls(job));
  drawn = key;
  if (!isSettled) settle(job);
}

export function setUpObjectWork() {
  watch("objectWork", draw);
  for (const what of ["scene", "objects"]) watch(what, () => draw(known("objectWork")));
}
