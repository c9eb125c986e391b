// Long work: starting it, watching it, pausing, cancelling, and taking the results.
import { get, post, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { inWords, labelOf, objects, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { act, tellFailure } from "./toasts.js";

const KINDS = {
  collect_pushes: "Pushes", collect_object: "Object images", collect_table: "Table images", fetch_assets: "Fetch objects",
  add_object: "New object",
  train_field: "Field", estimate: "Estimate", episode: "Episode", clip: "Clip", photo: "Photo", robot: "Robot",
};
export const LIVE = new Set(["queued", "running", "paused"]);
const number = (name, label, value, min, max) => ({ name, label, value, min, max, type: "number" });
const FIELDS = {
  collect_pushes: () => [
    number("episodes", "Episodes", 100, 1, 100000),
    number("steps", "Steps each", 50, 1, 1000),
    number("objects", "Objects", 3, 1, 8),
    { name: "policy", label: "Policy", options: [["paper", "random, as in the paper"], ["directed", "seeks contact"]] },
    number("seed", "Seed", 0, 0, 2147483647),
  ],
  collect_object: () => [
    { name: "name", label: "Object", options: objects().filter((o) => o.available).map((o) => [o.name, o.label]) },
    number("images", "Images", 300, 60, 5000),
    number("size", "Size in px", 128, 16, 1024),
    number("seed", "Seed", 0, 0, 2147483647),
  ],
  collect_table: () => [
    number("images", "Images", 300, 60, 5000),
    number("size", "Size in px", 128, 16, 1024),
    number("seed", "Seed", 0, 0, 2147483647),
  ],
};
const LATEST = { train_field: "training", estimate: "estimate", episode: "episode", fetch_assets: "objectWork", add_object: "objectWork", clip: "clip" }; // what the page knows of a kind
const jobs = new Map();
const nodes = new Map();
let older = null; // where the jobs that are not shown yet begin

function field({ name, label, options, ...properties }) {
  const input = options
    ? el("select", { name }, ...options.map(([value, text]) => el("option", { value, textContent: text })))
    : el("input", { name, required: true, step: 1, ...properties });
  return el("label", { className: "field" }, label, input);
}

function drawFields() {
  const kind = byId("new-job").elements.kind.value;
  byId("job-fields").replaceChildren(...FIELDS[kind]().map(field));
}

async function start(event) {
  event.preventDefault();
  const form = byId("new-job");
  const params = {};
  for (const input of byId("job-fields").querySelectorAll("input, select")) {
    params[input.name] = input.type === "number" ? Number(input.value) : input.value;
  }
  await act(form.querySelector("[type=submit]"), async () => showJob(await post("jobs", { kind: form.elements.kind.value, params })));
}

export function timeLeft(seconds) {
  if (seconds === null) return "";
  if (seconds < 90) return `, about ${Math.ceil(seconds)} s left`;
  return seconds < 5400 ? `, about ${Math.round(seconds / 60)} min left` : `, about ${(seconds / 3600).toFixed(1)} h left`;
}

export function stateText(job) {
  if (job.state === "queued") return `waiting, number ${job.position ?? "?"} in line`;
  // What training says of the time left leaves out what comes after it.
  if (job.state === "running") return `${inWords(job.note).replace(/(^|, )[^,]* left$/, "") || "running"}${timeLeft(job.eta_s)}`;
  if (job.state === "paused") return "paused";
  if (job.kind === "train_field") return `${job.state}${outcome(job)}`;
  return `${job.state}${job.total ? `, ${job.done} of ${job.total}` : ""}${outcome(job)}`;
}

/** A field's PSNR on images that it was not trained on. */
export function psnrText({ psnr_full: full, psnr_mask: mask }) {
  return `${full.toFixed(1)} dB, ${mask.toFixed(1)} dB in the mask`;
}

function outcome({ result }) {
  if (Number.isFinite(result?.psnr_mask)) return `, ${psnrText(result)}`;
  if (result?.contact_share === undefined || !result.episodes_per_s) return "";
  const percent = (share) => `${(100 * share).toFixed(0)} %`;
  return `, contact in ${percent(result.contact_share)} of the steps, motion in ${percent(result.motion_share)}`;
}

/** What was asked for, in one line. */
function orderText({ kind, params: p }) {
  if (kind === "collect_pushes") return `${p.episodes} × ${p.steps} steps, ${p.objects} objects, ${p.policy} policy, seed ${p.seed}`;
  if (kind === "fetch_assets") return p.names?.length ? p.names.map(labelOf).join(", ") : "all from the package index";
  if (kind === "add_object") return `from ${p.file_name}`;
  if (kind === "train_field") return `${p.minutes} min from ${p.source.mesh ? `${p.images} images of its mesh` : "an uploaded set"}, seed ${p.seed}`;
  if (kind === "clip" || kind === "photo") return `of ${p.title}`;
  if (kind === "estimate") return `${p.mode} frame of ${p.of.file_name ?? "a scene"}, ${p.names.length} objects, seed ${p.seed}`;
  if (kind === "episode") return `${p.names.map(labelOf).join(", ")}; ${p.settings.cost} cost, at most ${p.settings.steps} steps`;
  if (kind === "robot") return `${p.names.map(labelOf).join(", ")}; at most ${p.settings.steps} steps`;
  return `${p.images} images of ${p.size} px, seed ${p.seed}`;
}

export function titleText({ kind, params }) {
  const label = params.object?.label || (objects().find((object) => object.name === params.name)?.label ?? params.name);
  return label ? `${KINDS[kind]}: ${label}` : KINDS[kind];
}

function command(text, className, action) {
  const button = el("button", { type: "button", className, textContent: text });
  button.addEventListener("click", () => act(button, async () => showJob(await action())));
  return button;
}

export function controls(job) {
  if (job.kind === "episode") return [showEpisode(job)]; // its own tab has the rest
  const buttons = [];
  if (job.state === "running") buttons.push(command("Pause", "plain", () => post(`jobs/${job.id}/pause`)));
  if (job.state === "paused") buttons.push(command("Resume", "plain", () => post(`jobs/${job.id}/resume`)));
  if (LIVE.has(job.state)) buttons.push(command("Cancel", "plain danger", () => remove(`jobs/${job.id}`)));
  if (["train_field", "fetch_assets"].includes(job.kind) && job.state === "failed") {
    buttons.push(command("Start again", "plain", () => post("jobs", { kind: job.kind, params: job.params })));
  }
  for (const name of job.files) {
    buttons.push(el("a", { href: `api/jobs/${job.id}/files/${encodeURIComponent(name)}`, textContent: name, download: name }));
  }
  return buttons;
}

function showEpisode(job) {
  return el("button", { type: "button", className: "plain", textContent: "Show", on: { click() {
    showTab("episode");
    set("opened", { id: job.id });
  } } });
}

function deleteButton({ id }) {
  return doubted(el("button", { type: "button", className: "plain danger", textContent: "Delete" }), "Really delete", async () => {
    await remove(`jobs/${id}?forget=true`);
    dropJob(id);
  });
}

function controlsKey(job) {
  return `${job.state} ${job.files.join()}`;
}

/** Draws a job once and then changes what changed, so that a button under the pointer stays. */
function draw(job, isOlder) {
  let node = nodes.get(job.id);
  if (!node) {
    node = {
      bar: el("progress", { max: 1 }), text: el("span", { className: "state" }), error: el("span", { className: "error" }),
      actions: el("div", { className: "actions" }), key: "",
    };
    const made = new Date(job.created_at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    const head = el("span", { className: "title", textContent: titleText(job), title: `${job.id}, asked for ${made}` });
    const order = el("span", { className: "hint", textContent: orderText(job) });
    node.say = () => {
      head.textContent = titleText(job);
      order.textContent = orderText(job);
    };
    node.item = el("li", {}, head, order, node.bar, node.text, node.error, node.actions);
    node.item.dataset.job = job.id;
    nodes.set(job.id, node);
    byId("job-list")[isOlder ? "append" : "prepend"](node.item);
  }
  node.item.dataset.state = job.state;
  node.bar.hidden = !LIVE.has(job.state);
  node.bar.value = job.total ? job.done / job.total : 0;
  node.bar.setAttribute("aria-label", `${titleText(job)}, ${job.done} of ${job.total}`);
  node.text.textContent = stateText(job);
  node.error.textContent = inWords(job.error ?? "");
  node.error.hidden = !job.error;
  if (node.key !== controlsKey(job)) {
    node.actions.replaceChildren(...controls(job), LIVE.has(job.state) ? "" : deleteButton(job));
  }
  node.key = controlsKey(job);
}

/** The job of a kind that runs, else the one that was asked for last. */
function latest(kind) {
  const all = [...jobs.values()].filter((job) => job.kind === kind);
  const newest = (last, job) => (last && last.created_at > job.created_at ? last : job);
  return all.find((job) => job.state === "running" || job.state === "paused") ?? all.reduce(newest, undefined);
}

function tell(job) {
  const { kind } = job;
  byId("no-jobs").hidden = jobs.size > 0;
  const live = [...jobs.values()].filter((other) => LIVE.has(other.state)).length;
  byId("jobs-count").textContent = live;
  byId("jobs-count").hidden = live === 0;
  if (LATEST[kind]) set(LATEST[kind], latest(kind));
  if (kind === "photo") set("photoJob", job); // each photo follows its own
}

export function showJob(job, { isOlder = false } = {}) {
  jobs.set(job.id, job);
  draw(job, isOlder);
  tell(job);
}

/** Forgets a job that was removed for good. */
export function dropJob(id) {
  const job = jobs.get(id);
  if (!job) return;
  jobs.delete(id);
  nodes.get(id).item.remove();
  nodes.delete(id);
  tell(job);
}

function offerOlder(answer) {
  older = answer.next;
  byId("more-jobs").hidden = older === null;
}

export async function refreshJobs() {
  const before = [...jobs.keys()];
  const answer = await tellFailure(() => get("jobs"));
  if (!answer) return;
  const there = new Set(answer.jobs.map(({ id }) => id));
  for (const id of before) if (!there.has(id)) dropJob(id);
  for (const job of [...answer.jobs].reverse()) showJob(job);
  offerOlder(answer);
}

async function showOlder() {
  const answer = await get(`jobs?after=${older}`);
  for (const job of answer.jobs) showJob(job, { isOlder: true });
  offerOlder(answer);
}

export function setUpJobs() {
  const form = byId("new-job");
  form.addEventListener("submit", start);
  form.elements.kind.addEventListener("change", drawFields);
  const more = byId("more-jobs");
  more.addEventListener("click", () => act(more, showOlder));
  let offered = "";
  watch("objects", () => {
    for (const node of nodes.values()) node.say(); // by the names that people use
    const now = JSON.stringify(FIELDS.collect_object());
    if (now !== offered) drawFields(); // else what was filled in stays
    offered = now;
  });
}
