// What is being done for the objects, where they are: fetching, or making one of a mesh; and what went wrong.
import { byId } from "./dom.js";
import { LIVE, controls, stateText, titleText } from "./jobs.js";
import { refreshObjects, sizeText } from "./objects.js";
import { clearMesh } from "./own-object.js";
import { inWords, watch } from "./state.js";

let followed = ""; // the job that was seen at work, whose end is told, too
let drawn = "";

function endText(job) {
  if (job.state !== "done" || job.kind !== "add_object") return stateText(job);
  return `Ready: ${sizeText(job.result.size_m)}. It can be put on the table; to be recognised, it needs a field.`;
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
  const key = `${job.id} ${job.state}`;
  if (drawn === key) return;
  byId("object-work-actions").replaceChildren(...controls(job));
  drawn = key;
  settle(job);
}

export function setUpObjectWork() {
  watch("objectWork", draw);
}
