// Estimates of poses and light: asking for one, following it, and what came of it.
import { get, post, remove, upload } from "./api.js";
import { LatestImage } from "./cameras.js";
import { drawCurves, drawKey } from "./curves.js";
import { byId, el } from "./dom.js";
import { LIVE, stateText } from "./jobs.js";
import { inWords, labelOf, watch } from "./state.js";
import { act, tellFailure, toast } from "./toasts.js";

const PICTURE_MS = 700; // rendering takes time from the estimator
const form = () => byId("new-estimate");
const deg = (radians) => (radians * 180) / Math.PI;
const SIGMAS = 2;
const two = (value) => (value === null ? "any" : Number(value.toPrecision(2)).toString());
const picture = new LatestImage(byId("estimate-image"));
let shown = { id: "", state: "" };
let wanted = null; // the estimate whose details are to be fetched next
let isFetching = false;
let pictureAt = 0;
let details = null;

// Asking

async function start() {
  const { mode, seed, method } = form().elements;
  await post("estimates", { mode: mode.value, seed: Number(seed.value), method: method.value });
}

async function send(blob, name) {
  const bar = byId("observation-bar");
  const { mode, seed, method } = form().elements;
  const query = new URLSearchParams({ mode: mode.value, seed: seed.value, method: method.value, file_name: name.slice(-200) });
  bar.hidden = false;
  bar.value = 0;
  try {
    await upload(`estimates?${query}`, blob, (share) => { bar.value = share; });
  } finally {
    bar.hidden = true;
  }
}

async function sendFolder(files) {
  const named = [...files].map((file) => ({ name: file.webkitRelativePath || file.name, blob: file }));
  if (!named.some(({ name }) => name.split("/").at(-1) === "observation.json")) {
    throw new Error("The folder holds no observation.json; an observation folder is expected.");
  }
  const entries = await Promise.all(named.map(async ({ name, blob }) => [name, new Uint8Array(await blob.arrayBuffer())]));
  const { zipSync } = await import("../vendor/fflate-0.8.3.js"); // few need it
  const zip = zipSync(Object.fromEntries(entries), { level: 0 }); // PNGs do not shrink
  await send(new Blob([zip], { type: "application/zip" }), named[0].name.split("/")[0]);
}

// Following

function draw(job) {
  byId("estimating").hidden = !job;
  if (!job) return;
  const before = shown;
  shown = { id: job.id, state: job.state };
  const isLive = LIVE.has(job.state);
  const of = job.params.of.file_name ?? "the scene";
  byId("estimating").dataset.state = job.state;
  const what = { first: `First frame of ${of}`, next: `Next frame of ${of}`, goal: `Goal view of ${of}` }[job.params.mode];
  byId("estimating-title").textContent = `${what}${job.params.method === "paper" ? ", as published" : ""}`;
  byId("estimating-stage").textContent = isLive ? (job.result?.stage ?? "") : "";
  byId("estimating-bar").hidden = !isLive;
  byId("estimating-bar").value = job.total ? job.done / job.total : 0;
  byId("estimating-state").textContent = isLive ? stateText(job) : job.state;
  byId("estimating-error").textContent = inWords(job.error ?? "");
  byId("estimating-error").hidden = !job.error;
  byId("cancel-estimate").hidden = !isLive;
  if (before.id !== job.id) begin(job);
  if (before.id === job.id && before.state !== job.state && job.state === "failed") toast(job.error, "error");
  wanted = job.id;
  fetchDetails();
}

function begin(job) {
  details = null;
  pictureAt = 0;
  drawCurves(byId("loss-curves"), [], []);
  drawKey(byId("loss-key"), job.params.names.map(labelOf));
  byId("estimate-camera").replaceChildren(...job.params.cameras.map((name, view) =>
    el("option", { value: view, textContent: /^\d+$/.test(name) ? `Camera ${name}` : name })));
  picture.clear();
  byId("estimate-images").hidden = byId("estimate-result").hidden = true;
}

/** Fetches what the latest event was about, one request at a time. */
async function fetchDetails() {
  if (isFetching) return;
  isFetching = true;
  while (wanted) {
    const id = wanted;
    wanted = null;
    const found = await tellFailure(() => get(`estimates/${id}`));
    if (found && found.id === shown.id) drawDetails(found);
  }
  isFetching = false;
}

function drawDetails(found) {
  details = found;
  byId("losses").hidden = found.steps.length === 0;
  drawCurves(byId("loss-curves"), found.objects, found.steps);
  drawPicture();
  byId("estimate-result").hidden = !found.estimate;
  if (found.estimate) drawResult(found);
}

/** Only while somebody looks at it, not too often, and always the last one. */
function drawPicture({ isUrgent = false } = {}) {
  const gone = !details?.steps.length || details.status === "cancelled" || details.status === "failed";
  byId("estimate-images").hidden = gone;
  if (gone || byId("panel-estimate").hidden) return;
  if (!isUrgent && LIVE.has(details.status) && performance.now() - pictureAt < PICTURE_MS) return;
  pictureAt = performance.now();
  const { step } = details.steps.at(-1);
  picture.show(`api/estimates/${details.id}/images/${byId("estimate-camera").value}.png?kind=comparison&step=${step}`);
}

// What came of it

function row(object, error) {
  const { position_std_m: position, rotation_std_rad: rotation } = object.uncertainty;
  const item = el(
    "tr", { className: object.doubt ? "doubtful" : "" },
    el("td", {}, labelOf(object.name), object.doubt ? el("span", { className: "missing", textContent: `doubtful: ${object.doubt}` }) : null),
    el("td", { textContent: object.position.map((value) => (100 * value).toFixed(1)).join(", ") }),
    el("td", { textContent: two(position === null ? null : 1000 * SIGMAS * position) }),
    el("td", { textContent: two(rotation === null ? null : deg(SIGMAS * rotation)) }),
    el("td", { className: "off" }, error ? `${two(error.position_mm)} mm` : "", error ? el("br") : null, error ? `${two(error.rotation_deg)}°` : ""),
  );
  item.dataset.object = object.name;
  return item;
}

function lightRow(light, simulation) {
  const [x, y, z] = light.position;
  const azimuth = (deg(Math.atan2(y, x)) + 360) % 360;
  const elevation = deg(Math.asin(Math.min(Math.max(z, -1), 1)));
  const deviation = light.uncertainty.direction_std_rad;
  const item = el(
    "tr", {},
    el("td", { textContent: "Light" }),
    el("td", { textContent: `${azimuth.toFixed(0)}°, ${elevation.toFixed(0)}° up`, title: "azimuth and elevation" }),
    el("td", { textContent: "" }),
    el("td", { textContent: two(deviation === null ? null : deg(SIGMAS * deviation)) }),
    el("td", { className: "off", textContent: simulation ? `${two(simulation.light_deg)}°` : "" }),
  );
  item.dataset.object = "light";
  return item;
}

function drawResult({ id, estimate, simulation, files }) {
  const errors = new Map((simulation?.objects ?? []).map((error) => [error.name, error]));
  byId("estimate-trust").textContent = estimate.trusted ? "Trusted" : "Not trusted";
  byId("estimate-trust").dataset.state = estimate.trusted ? "live" : "lost";
  byId("estimate-rows").replaceChildren(
    ...estimate.objects.map((object) => row(object, errors.get(object.name))), lightRow(estimate.light, simulation));
  byId("estimate-result").classList.toggle("simulated", Boolean(simulation));
  byId("estimate-off").hidden = !simulation;
  byId("simulation-note").hidden = !simulation;
  byId("download-state").hidden = !files.includes("state.json");
  byId("download-state").href = `api/jobs/${id}/files/state.json`;
}

export function setUpEstimate() {
  form().addEventListener("submit", (event) => {
    event.preventDefault();
    act(form().querySelector("[type=submit]"), start);
  });
  byId("observation-folder").webkitdirectory = true; // not an attribute of HTML
  for (const [button, input, action] of [
    ["upload-observation", "observation-file", (files) => send(files[0], files[0].name)],
    ["upload-folder", "observation-folder", sendFolder],
  ]) {
    byId(button).addEventListener("click", () => byId(input).click());
    byId(input).addEventListener("change", () => {
      const files = [...byId(input).files];
      byId(input).value = "";
      if (files.length) act(byId(button), () => action(files));
    });
  }
  const cancel = byId("cancel-estimate");
  cancel.addEventListener("click", () => act(cancel, () => remove(`estimates/${shown.id}`)));
  byId("estimate-camera").addEventListener("change", () => drawPicture({ isUrgent: true }));
  byId("tab-estimate").addEventListener("click", () => drawPicture({ isUrgent: true }));
  watch("objects", () => {
    if (details) drawKey(byId("loss-key"), details.objects.map(labelOf));
    if (details?.estimate) drawResult(details);
  });
  watch("estimate", draw);
}
