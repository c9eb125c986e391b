// Fields: what there is and how good it is, training new ones from a mesh or an uploaded image set, watching it.
import { get, getAll, post, remove, upload } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { LIVE, controls, psnrText, showJob, stateText, titleText } from "./jobs.js";
import { nextStep, stepKey } from "./next-step.js";
import { inWords, known, objects, set, watch } from "./state.js";
import { scrollTo, showTab } from "./tabs.js";
import { act, tellFailure, toast } from "./toasts.js";

const [S_PER_IMAGE, S_PER_IMAGE_OF_SET] = [0.2, 0.115]; // taken, measured and compared, as the service reckons
const PREPARING_MIN = 0.2; // loading
let sets = [];
let shown = { id: "", state: "", controls: "", preview: "" };

const form = () => byId("new-field");
const source = () => form().elements.from.value;

function options(select, entries, empty) {
  const before = select.value;
  select.replaceChildren(...entries.map(([value, text]) => el("option", { value, textContent: text })));
  if (!entries.length) select.append(el("option", { value: "", textContent: empty }));
  if (entries.some(([value]) => value === before)) select.value = before;
}

function entry(field) {
  const { psnr_full: full, psnr_mask: mask, minutes } = field.metrics;
  const quality = Number.isFinite(full) && Number.isFinite(mask) ? psnrText(field.metrics) : "not measured";
  const origin = field.source === "trained" ? "trained here" : "shipped, trained";
  const effort = Number.isFinite(minutes) ? ` in ${Number(minutes.toPrecision(2))} min` : "";
  const item = el(
    "li", {},
    el("div", { className: "row" },
      el("span", { className: "title", textContent: field.label, title: field.name }),
      field.source === "trained" ? deleteButton(field.name) : null),
    el("details", {},
      el("summary", { className: "hint", textContent: "Details" }),
      el("p", { className: "state", textContent: quality }),
      el("p", { className: "hint", textContent: `${(field.bytes / 1e6).toFixed(2)} MB, ${origin}${effort}` })),
    published(field),
    field.has_mesh ? null : el("span", { className: "missing", textContent: "needs a mesh for scenes", title: inWords(field.note ?? "") }),
  );
  item.dataset.field = field.name;
  return item;
}

/** What is told of a field as published beside ours; null if there is none. */
function published({ name, published: origin }) {
  if (!origin) return null;
  const text = `Also as published, ${origin === "trained" ? "trained here" : "shipped"}`;
  return el("div", { className: "row" }, el("span", { className: "hint", textContent: text }), origin === "trained" ? deleteButton(name, "?method=paper") : null);
}

function deleteButton(name, query = "") {
  return doubted(el("button", { type: "button", className: "plain danger", textContent: "Delete" }), "Really delete", async () => {
    await remove(`fields/${encodeURIComponent(name)}${query}`);
    await refreshFields();
  });
}

export async function refreshFields() {
  const answer = await tellFailure(() => get("fields"));
  if (!answer) return;
  set("fields", answer.fields);
  byId("field-list").replaceChildren(...answer.fields.map(entry));
  byId("no-fields").hidden = answer.fields.length > 0;
  byId("fields-hint").hidden = answer.fields.length === 0;
}

// Image sets

export async function refreshSets() {
  const uploaded = await tellFailure(() => getAll("fields/sets", "sets"));
  if (uploaded) drawSets(uploaded);
}

function drawSets(now) {
  sets = now;
  options(form().elements.set, sets.map((set) => [set.id, set.file_name]), "none uploaded yet");
  drawSet();
}

function drawSet() {
  const chosen = sets.find((set) => set.id === form().elements.set.value);
  const format = "A zip with train/anno.json, test/anno.json and RGBA images beside them, in the OSF format.";
  byId("set-facts").textContent = chosen ? `${chosen.summary}. The pictures show how it was understood.` : format;
  byId("delete-set").hidden = !chosen;
  const overlay = byId("set-overlay");
  overlay.hidden = !chosen;
  if (chosen) overlay.src = `api/fields/sets/${chosen.id}/overlay.png`;
  else overlay.removeAttribute("src");
}

async function uploadSet(file) {
  const bar = byId("upload-bar");
  const told = byId("set-facts");
  bar.hidden = false;
  bar.value = 0;
  told.textContent = `Uploading ${file.name}`;
  const progress = (share) => {
    bar.value = share;
    if (share === 1) told.textContent = `Checking ${file.name}: unpacking it and looking at every image`;
  };
  try {
    const set = await upload(`fields/sets?file_name=${encodeURIComponent(file.name.slice(-200))}`, file, progress);
    drawSets([...sets, set]);
    form().elements.set.value = set.id;
    if (!form().elements.name.value) form().elements.name.value = nameFrom(file.name);
  } finally {
    bar.hidden = true;
    drawSet();
  }
}

/** A name that the service takes, made from a file's. */
function nameFrom(file) {
  const plain = file.toLowerCase().replace(/\.zip$/, "").replace(/[^a-z0-9_-]+/g, "_");
  return plain.replace(/^[^a-z0-9]+/, "").slice(0, 64);
}

async function deleteSet() {
  await remove(`fields/sets/${form().elements.set.value}`);
  await refreshSets();
}

// Training

async function train() {
  const { mesh, set, name, images, minutes, seed, method, hollow } = form().elements;
  const isMesh = source() === "mesh";
  if (isMesh && !mesh.value) throw new Error("No meshes are on this machine yet; fetch objects first.");
  if (!isMesh && !set.value) throw new Error("Upload a zip with an image set first.");
  if (!isMesh && !name.value.trim()) throw new Error("Give the object a name.");
  const params = {
    name: isMesh ? mesh.value : name.value.trim(),
    source: isMesh ? { mesh: mesh.value } : { set: set.value },
    minutes: Number(minutes.value),
    seed: Number(seed.value),
    method: method.value,
    hollow: hollow.checked && method.value === "ours",
    ...(isMesh ? { images: Number(images.value) } : {}),
  };
  showJob(await post("jobs", { kind: "train_field", params }));
}

/** Leads on to the training of an object's field, with everything filled in. */
export function prepareTraining(name) {
  form().elements.from.value = "mesh";
  drawSource();
  form().elements.mesh.value = name;
  showTab("fields");
  scrollTo(form().closest(".card"));
  form().querySelector("[type=submit]").focus({ preventScroll: true });
}

function drawTime() {
  const { minutes, images } = form().elements;
  const collecting = (Number(images.value) * (source() === "mesh" ? S_PER_IMAGE : S_PER_IMAGE_OF_SET)) / 60;
  const whole = Number(minutes.value) + collecting + PREPARING_MIN;
  byId("training-time").textContent = Number.isFinite(whole) ? `Takes about ${Math.max(Math.round(whole), 1)} min on an idle machine.` : "";
}

function drawTraining(job) {
  byId("training").hidden = !job;
  if (!job) return;
  const before = shown;
  const result = job.result ?? {};
  const label = objects().find((object) => object.name === job.params.name)?.label ?? job.params.name;
  byId("training").dataset.state = job.state;
  byId("training-title").textContent = `${label}${job.params.method === "paper" ? ", as published" : ""}`;
  byId("training-title").title = titleText(job);
  const soFar = LIVE.has(job.state) ? " so far, on a few unseen images" : "";
  byId("training-psnr").textContent = Number.isFinite(result.psnr_mask) ? `${psnrText(result)}${soFar}` : "";
  byId("training-bar").hidden = !LIVE.has(job.state);
  byId("training-bar").value = job.total ? job.done / job.total : 0;
  // PSNR stands in the head already.
  byId("training-state").textContent = job.state === "done" ? "done; measured on all unseen images, before only on a few" : stateText(job).replace(/^.*dB.*, (?=.* left$)/, "");
  byId("training-error").textContent = inWords(job.error ?? "");
  byId("training-error").hidden = !job.error;
  const preview = result.previews && job.state !== "failed" && job.state !== "cancelled"
    ? `api/jobs/${job.id}/preview.png?v=${result.previews}` : "";
  const { name } = job.params;
  const isUsable = job.state === "done" && objects().some((object) => object.name === name && object.available);
  const key = `${job.state} ${job.files.join()} ${isUsable ? stepKey(name) : ""}`;
  shown = { id: job.id, state: job.state, controls: key, preview };
  if (before.id !== job.id || before.controls !== key) {
    byId("training-actions").replaceChildren(...(isUsable ? [nextStep(name)] : []), ...controls(job));
  }
  if (before.preview !== preview) drawPreview(preview);
  drawComparison(job, label);
  if (before.id === job.id && before.state !== job.state) tellEnd(job, label);
}

const used = new Set(); // jobs whose field was put to use by hand

/** How the new field compares with the one that was there. */
function drawComparison(job, label) {
  const { before_full: full, before_mask: mask, psnr_mask: now, in_use: inUse } = job.result ?? {};
  const isCompared = job.state === "done" && Number.isFinite(mask);
  byId("comparison").hidden = !isCompared;
  if (!isCompared) return;
  const both = `On the same unseen images the field of ${label} that was there has ${psnrText({ psnr_full: full, psnr_mask: mask })}`;
  const isNewUsed = inUse || used.has(job.id);
  byId("comparison-text").textContent = isNewUsed
    ? `${both}. The new one${now >= mask ? " is no worse, and" : ""} is in use now.`
    : `${both}. That is better, so it stays in use.`;
  byId("comparison-choice").hidden = isNewUsed;
  const address = `api/jobs/${job.id}/comparison.png`;
  if (byId("comparison-image").getAttribute("src") !== address) byId("comparison-image").src = address;
}

async function useNew() {
  const job = known("training");
  await post(`fields/${encodeURIComponent(job.params.name)}/use`, { job: job.id });
  used.add(job.id);
  drawTraining(job);
  await refreshFields();
}

function drawPreview(address) {
  byId("training-preview").hidden = !address;
  if (address) byId("training-image").src = address;
  else byId("training-image").removeAttribute("src");
}

function tellEnd(job, label) {
  if (job.state === "done") {
    if (job.result?.in_use !== false) toast(`The field ${job.params.method === "paper" ? "as published " : ""}of ${label} is ready.`);
    refreshFields();
  } else if (job.state === "failed") {
    toast(job.error, "error");
  }
}

function drawSource() {
  byId("from-mesh").hidden = source() !== "mesh";
  byId("from-set").hidden = source() !== "set";
  const isPaper = form().elements.method.value === "paper";
  byId("hollow-choice").hidden = isPaper;
  byId("published-hint").hidden = !isPaper;
  form().elements.images.disabled = source() !== "mesh"; // what is hidden must not hold the form up
  drawTime();
}

export function setUpFields() {
  const file = byId("set-file");
  const button = byId("upload-set");
  form().addEventListener("submit", (event) => {
    event.preventDefault();
    act(form().querySelector("[type=submit]"), train);
  });
  form().addEventListener("change", drawSource);
  form().addEventListener("input", drawTime);
  drawTime();
  form().elements.set.addEventListener("change", drawSet);
  button.addEventListener("click", () => file.click());
  file.addEventListener("change", () => {
    const [chosen] = file.files;
    if (chosen) act(button, () => uploadSet(chosen));
    file.value = "";
  });
  byId("use-new-field").addEventListener("click", () => act(byId("use-new-field"), useNew));
  doubted(byId("delete-set"), "Really delete set", deleteSet);
  byId("training-image").addEventListener("error", () => drawPreview(""));
  byId("to-fields").addEventListener("click", () => showTab("fields"));
  watch("objects", () => {
    const there = objects().filter((object) => object.available);
    options(form().elements.mesh, there.map((object) => [object.name, object.label]), "none fetched yet");
    refreshFields();
  });
  watch("training", drawTraining);
  watch("scene", () => drawTraining(known("training")));
}
