// Photos of tables: sent, marked, looked at; then one becomes the goal, or the table.
import { get, getAll, patch, post, put, remove, upload } from "./api.js";
import { byId, el, shareOn } from "./dom.js";
import { doubted } from "./doubt.js";
import { mayDrive } from "./driver.js";
import { takeGoal } from "./goals.js";
import { LIVE, stateText } from "./jobs.js";
import { drawMarks, setBrush, setBusy, setDrawing, setTool, setUpMarks, wipeTo } from "./photo-marks.js";
import { refreshScenes } from "./scenes.js";
import { inWords, known, labelOf, set, watch } from "./state.js";
import { scrollTo, showTab } from "./tabs.js";
import { act, tellFailure, toast } from "./toasts.js";

const NAME_MAX = 100;
const MOST_MARKS = 50; // clicks or strokes of one outline
const CHOSEN = "osf-photo"; // what this page has chosen outlives a reload of it
let photos = [];
let photo = null;
let chosen = ""; // the object that is marked next
let seen = ""; // the state of the search that was drawn last
let doubtsOf = ""; // the search whose doubts were taken as they are, or not
let before = null; // {name, mark}: what an outline was before it was mended last
let isMarking = false;
let marking = Promise.resolve(); // the mark that was made last

const path = (rest = "") => `photos/${encodeURIComponent(photo.id)}${rest}`;
const objectPath = (name, rest = "") => path(`/objects/${encodeURIComponent(name)}${rest}`);
const marked = (name = chosen) => photo?.objects.find((object) => object.name === name);
const isFound = () => Boolean(photo?.objects.some(({ found }) => found));

// What is on view

function toolOf() {
  return document.querySelector('input[name="photo-tool"]:checked').value;
}

function chooseTool(name) {
  document.querySelector(`input[name="photo-tool"][value="${name}"]`).checked = true;
  setTool(name);
  tell();
}

function tell() {
  const name = labelOf(chosen);
  const words = {
    box: `Drag a box around the ${name.toLowerCase()} in the photo.`,
    add: `Click on the ${name.toLowerCase()}, or paint over what its outline lacks.`,
    remove: `Click beside the ${name.toLowerCase()}, or paint over what does not belong to it.`,
  };
  byId("photo-told").textContent = chosen ? marked()?.doubt || words[toolOf()] : "No object has a field yet; train one in Your objects.";
}

function choose(name, tool = marked(name) ? "add" : "box") {
  chosen = name;
  byId("photo-object").value = name;
  chooseTool(tool);
  drawMarks(photo, chosen);
  for (const item of byId("photo-objects").children) item.classList.toggle("chosen", item.dataset.object === name);
}

function drawChoices() {
  const names = (known("fields") ?? []).map(({ name }) => name);
  byId("photo-object").replaceChildren(...names.map((name) => el("option", { value: name, textContent: labelOf(name) })));
  if (!names.includes(chosen)) chosen = names.find((name) => !marked(name)) ?? names[0] ?? "";
  byId("photo-object").value = chosen;
  tell();
}

function poseButton(object, pose, number) {
  const isTaken = number === (object.choice ?? 0);
  const sure = pose.probability === null ? "" : ` (${(100 * pose.probability).toFixed(0)} %)`;
  const likely = (number ? `orientation ${number + 1}` : "most likely") + sure;
  const button = el(
    "button", { type: "button", attributes: { "aria-pressed": String(isTaken), "aria-label": `${object.label}, ${likely}` } },
    pose.picture ? el("img", { src: pose.picture.slice(1), alt: "Photo, outlines, and the object as it would lie", loading: "lazy" }) : null,
    el("span", { textContent: `${likely}, outline fits by ${(100 * pose.iou).toFixed(0)} %` }),
  );
  button.addEventListener("click", () => act(button, async () => show(await post(objectPath(object.name, "/choice"), { choice: number }))));
  return button;
}

function posesOf({ found, choice, ...object }) {
  const doubtful = found.doubt && choice === null;
  const all = found.poses.map((pose, number) => poseButton({ choice, ...object }, pose, number));
  const others = el("details", { open: Boolean(doubtful) }, el("summary", { className: "hint", textContent: `Other orientations (${all.length - 1})` }), el("div", { className: "photo-poses" }, ...all.slice(1)));
  return [
    doubtful ? el("p", { className: "missing", textContent: inWords(found.doubt) }) : null,
    el("div", { className: "photo-poses" }, all[0]), all.length > 1 ? others : null,
  ];
}

function entry(object) {
  const pick = el("button", { type: "button", className: "plain", textContent: object.label });
  pick.addEventListener("click", () => choose(object.name));
  const drop = el("button", { type: "button", className: "plain danger", textContent: "Remove", attributes: { "aria-label": `Remove: ${object.label}` } });
  drop.addEventListener("click", () => act(drop, async () => show(await remove(objectPath(object.name)))));
  const doubt = object.doubt ? el("p", { className: "missing", textContent: object.doubt }) : null;
  const item = el("li", {}, el("div", { className: "marked" }, pick, drop), doubt, ...(object.found ? posesOf(object) : []));
  item.dataset.object = object.name;
  item.classList.toggle("chosen", object.name === chosen);
  return item;
}

const togetherWith = () => [...byId("photo-together").querySelectorAll("input:checked")].map(({ value }) => value);

function drawTogether() {
  const shared = ({ on_board, marked }) => (photo.on_board && on_board) || photo.objects.some(({ name }) => marked.includes(name));
  const others = photos.filter((other) => other.id !== photo.id && shared(other));
  const taken = new Set(togetherWith());
  byId("photo-together").replaceChildren(...others.map(({ id, name }) =>
    el("label", { title: "Another photo of the same objects, none of which was moved" }, el("input", { type: "checkbox", value: id, checked: taken.has(id) }), `together with ${name}`)));
}

function drawResult() {
  byId("photo-result").hidden = !isFound();
  byId("photo-doubts").hidden = !photo.doubts.length;
  if (doubtsOf !== photo.job?.id) byId("photo-despite").checked = false;
  doubtsOf = photo.job?.id;
  const { light } = photo;
  byId("photo-light").textContent = !light ? "" : light.diffuse ? "The light is diffuse: the photo shows no single lamp."
    : !photo.table ? "There is one lamp; its place cannot be found without a table."
    : `Lamp ${((Math.asin(Math.min(Math.max(light.direction[2], -1), 1)) * 180) / Math.PI).toFixed(0)}° above the table, ± ${light.std_deg.toFixed(1)}°${light.distance_m === null ? "" : `, ${light.distance_m.toFixed(2)} m away`}.`;
  const choices = photo.objects.map(({ choice }) => choice ?? 0).join("-");
  setDrawing(isFound() && photo.table ? `api/${path(`/drawing.png?${new URLSearchParams({ job: photo.job.id, choices })}`)}` : "");
}

function drawJob(job) {
  const isLive = LIVE.has(job?.state);
  const wasTold = !byId("photo-finding").hidden || !byId("photo-error").hidden;
  byId("photo-finding").hidden = !isLive;
  byId("photo-finding-bar").value = job?.total ? job.done / job.total : 0;
  byId("photo-finding-state").textContent = isLive ? inWords(stateText(job)) : "";
  byId("photo-error").hidden = job?.state !== "failed";
  byId("photo-error").textContent = inWords(job?.error ?? "");
  const told = isLive ? byId("photo-finding") : byId("photo-error");
  if (!wasTold && !told.hidden) told.scrollIntoView({ block: "nearest" });
  byId("find-objects").disabled = isLive || !photo?.objects.length;
}

function show(next) {
  photo = next;
  set("photo", photo);
  if (photo) sessionStorage.setItem(CHOSEN, photo.id);
  byId("photo-card").hidden = !photo;
  drawMarks(photo, chosen);
  drawStage();
  byId("photo-select").value = photo?.id ?? "";
  if (!photo) return;
  seen = `${photo.job?.id} ${photo.job?.state}`;
  byId("photo-name").textContent = photo.name;
  byId("photo-notes").replaceChildren(...photo.notes.map((note) => el("li", { textContent: inWords(note) })));
  byId("photo-camera").hidden = photo.focal_source === "board";
  byId("photo-camera").elements.focal.value = Math.round(photo.focal_px);
  byId("photo-board").elements.board.value = photo.board;
  byId("photo-objects").replaceChildren(...photo.objects.map(entry));
  drawTogether();
  drawJob(photo.job);
  drawResult();
  byId("photo-undo").hidden = before?.id !== photo.id || !marked(before.name);
  tell();
}

async function open(id) {
  const isAnother = id !== photo?.id;
  const next = await get(`photos/${encodeURIComponent(id)}`);
  if (!isAnother && JSON.stringify(next) === JSON.stringify(photo)) return;
  show(next);
  if (isAnother) choose(chosen);
}

/** The photo lies over the 3D view while its tab is open. */
function drawStage() {
  byId("photo-stage").hidden = !photo || byId("panel-photo").hidden;
}

// Doing

/** Shows a photo that has just been sent, and what to do with it. */
export async function showPhoto(id) {
  await refreshPhotos();
  await open(id);
  showTab("photo");
  scrollTo(byId("photo-card"));
}

async function sendPhoto(file) {
  if (!mayDrive()) return;
  const bar = byId("table-photo-bar");
  bar.hidden = false;
  bar.value = 0;
  await tellFailure(async () => {
    const query = new URLSearchParams({ name: file.name.slice(-NAME_MAX) });
    const sent = await upload(`photos?${query}`, file, shareOn(bar), "application/octet-stream");
    await showPhoto(sent.id);
  }, byId("upload-table-photo"));
  bar.hidden = true;
}

async function mark(body) {
  if (!chosen || !mayDrive()) return;
  setBusy(true);
  isMarking = true;
  byId("photo-told").textContent = "Finding its outline";
  const name = chosen;
  const was = marked();
  const next = await tellFailure(() => put(objectPath(name), body), byId("photo-told"));
  setBusy(false);
  isMarking = false;
  if (!next) return tell();
  before = was ? { id: photo.id, name, mark: markOf(was) } : null;
  show(next);
  return choose(name, toolOf() === "box" ? "add" : toolOf());
}

const isInside = ([x, y], [left, top, right, bottom]) => x >= left && x < right && y >= top && y < bottom;
const markOf = ({ box, on, off, strokes }) => ({ box, on, off, strokes });

function mend(change) {
  const object = marked();
  const next = object && change(markOf(object));
  if (object && Math.max(next.on.length, next.off.length, next.strokes.length) > MOST_MARKS) {
    byId("photo-told").textContent = `An outline takes ${MOST_MARKS} clicks and strokes at most; drag its box anew.`;
    return undefined;
  }
  if (object) return mark(next);
  byId("photo-told").textContent = `Drag a box around the ${labelOf(chosen).toLowerCase()} first.`;
  chooseTool("box");
  return undefined;
}

function click(point, tool) {
  if (tool === "box") { // a click on another object chooses it
    const hit = photo.objects.find(({ box }) => isInside(point, box));
    return hit ? choose(hit.name) : undefined;
  }
  return mend((mark) => {
    if (tool === "remove") return { ...mark, off: [...mark.off, point] };
    if (isInside(point, mark.box)) return { ...mark, on: [...mark.on, point] };
    return { ...mark, strokes: [...mark.strokes, { adds: true, radius: 3, points: [point] }] };
  });
}

/** Marks wait for those before them: each changes what the one before has left. */
function inTurn(work) {
  return (...mark) => {
    const { id } = photo;
    marking = marking.then(() => tellFailure(async () => (photo?.id === id ? work(...mark) : undefined)));
  };
}

/** Begins the search for what is marked. */
export async function findObjects() {
  show(await post(path("/find"), { together: togetherWith(), seed: 0 }));
}

async function make(what) {
  const made = await post(path(`/${what}`), { despite_doubts: byId("photo-despite").checked });
  set("scene", { ...made.scene, is_current: true });
  await refreshScenes();
  if (made.goal) takeGoal(made.goal);
  for (const note of made.notes) toast(note, "warning");
  showTab("episode");
  drawStage();
}

export async function refreshPhotos() {
  const all = await tellFailure(() => getAll("photos", "photos"));
  if (!all) return;
  photos = all;
  byId("photo-earlier").hidden = photos.length < 2;
  byId("photo-select").replaceChildren(...photos.map(({ id, name }) => el("option", { value: id, textContent: name })));
  const wanted = photo?.id ?? sessionStorage.getItem(CHOSEN);
  const there = photos.find(({ id }) => id === wanted) ?? (photo ? photos[0] : null);
  if (!there) show(null);
  else if (!isMarking) await tellFailure(() => open(there.id)); // another page may have marked something
  byId("photo-select").value = photo?.id ?? "";
}

export function setUpPhoto() {
  setUpMarks({
    onBox: inTurn((box) => mark({ box, on: [], off: [], strokes: [] })),
    onClick: inTurn(click),
    onStroke: inTurn((points, radius, tool) => mend((mark) => ({ ...mark, strokes: [...mark.strokes, { adds: tool === "add", radius, points }] }))),
  });
  const file = byId("table-photo-file");
  byId("upload-table-photo").addEventListener("click", () => file.click());
  file.addEventListener("change", () => {
    const [first] = file.files;
    if (first) act(byId("upload-table-photo"), () => sendPhoto(first));
    file.value = "";
  });
  byId("photo-select").addEventListener("change", ({ target }) => tellFailure(() => open(target.value)));
  doubted(byId("delete-photo"), "Really delete", async () => {
    await remove(path());
    sessionStorage.removeItem(CHOSEN);
    photo = null;
    await refreshPhotos();
    if (photos.length) await open(photos[0].id);
    else show(null);
  });
  byId("photo-camera").addEventListener("submit", (event) => {
    event.preventDefault();
    const { focal } = event.target.elements;
    act(event.submitter, async () => show(await patch(path(), { focal_px: focal.value ? Number(focal.value) : null })));
  });
  byId("photo-board").addEventListener("submit", (event) => {
    event.preventDefault();
    const { board } = event.target.elements;
    act(event.submitter, async () => show(await patch(path(), { focal_px: null, board: board.value.trim() })));
  });
  byId("use-camera").addEventListener("click", () => act(byId("use-camera"), async () => show(await patch(path(), { focal_px: null, camera: known("camera") }))));
  watch("camera", (camera) => { byId("photo-calibrated").hidden = !camera; });
  byId("photo-object").addEventListener("change", ({ target }) => choose(target.value));
  for (const radio of document.getElementsByName("photo-tool")) radio.addEventListener("change", () => chooseTool(radio.value));
  byId("photo-brush").addEventListener("input", ({ target }) => setBrush(Number(target.value)));
  byId("find-objects").addEventListener("click", async () => {
    await act(byId("find-objects"), findObjects);
    drawJob(photo?.job);
  });
  byId("photo-undo").addEventListener("click", () => act(byId("photo-undo"), async () => {
    choose(before.name, toolOf());
    await mark(before.mark);
  }));
  byId("photo-box-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const box = event.target.elements.box.value.split(",").map(Number);
    if (box.length === 4 && box.every(Number.isFinite)) act(event.submitter, () => mark({ box, on: [], off: [], strokes: [] }));
    else byId("photo-told").textContent = "A box is four numbers: left, top, right, bottom, in pixels of the photo.";
  });
  byId("cancel-finding").addEventListener("click", () => act(byId("cancel-finding"), () => remove(`jobs/${photo.job.id}`)));
  byId("photo-goal").addEventListener("click", () => act(byId("photo-goal"), () => make("goal")));
  byId("photo-table").addEventListener("click", () => act(byId("photo-table"), () => make("table")));
  new MutationObserver(drawStage).observe(byId("panel-photo"), { attributes: true, attributeFilter: ["hidden"] });
  watch("objects", drawChoices);
  watch("fields", drawChoices);
  watch("photoJob", (job) => {
    if (!photo || job?.params.photo !== photo.id || job.id !== photo.job?.id) return;
    if (LIVE.has(job.state)) return drawJob(job);
    if (seen === `${job.id} ${job.state}`) return undefined;
    return tellFailure(async () => {
      show(await get(path()));
      if (isFound() && photo.table) wipeTo(50);
      if (isFound()) byId("photo-result").scrollIntoView({ block: "nearest" });
    });
  });
}
