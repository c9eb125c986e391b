// A camera from photos of the board: sent one by one, each told at once whether the board is seen and what is missing.
import { post, upload } from "./api.js";
import { byId, el } from "./dom.js";
import { mayDrive } from "./driver.js";
import { set } from "./state.js";
import { act, tellFailure } from "./toasts.js";

const NAME_MAX = 100;
const KEPT = "osf-camera"; // the camera that was saved, for photos of later visits
const MOST_TOLD_MM = 100; // more is no figure that helps
let photos = []; // {id, name, file}, or {name, file, refused: why}
let table = null;
let camera = null;
let asked = 0; // the newest question; answers to older ones do not count

const inMm = (value) => (value < MOST_TOLD_MM ? `${value.toFixed(value < 10 ? 1 : 0)} mm` : "more than 10 cm");

function entry(photo, told) {
  const rms = told?.camera.reprojection_px[photo.name];
  const drop = el("button", { type: "button", className: "plain danger", textContent: "Remove", attributes: { "aria-label": `Remove: ${photo.name}` } });
  drop.addEventListener("click", () => act(drop, async () => {
    photos = photos.filter((each) => each !== photo);
    if (table === photo) table = null;
    await assess();
  }));
  const words = `${photo === table ? "On the table: " : ""}board seen${rms === undefined ? "" : `, corners ${rms.toFixed(2)} px off`}`;
  const found = el("span", { className: photo.refused ? "missing" : "hint", textContent: photo.refused ?? words });
  return el("li", {}, el("div", { className: "marked" }, el("span", { className: "title", textContent: photo.name }), drop), found);
}

/** Where the board lies on the table, as REST takes it. */
const place = () => Object.fromEntries([...new FormData(byId("board-place"))].map(([name, value]) => [name, Number(value)]));

function show(told) {
  byId("board-place").hidden = !table;
  const all = table ? [...photos, table] : photos;
  byId("board-photos").replaceChildren(...all.map((photo) => entry(photo, told)));
  byId("calibration-result").hidden = !told;
  camera = told && !told.missing ? told.camera : null;
  byId("save-camera").disabled = !camera;
  byId("camera-saved").hidden = true;
  if (!told) return;
  const error = told.camera.expected_error_mm;
  byId("calibration-meter").value = error?.mean ?? Infinity;
  byId("calibration-error").textContent = error ? `${inMm(error.mean)}, at worst ${inMm(error.worst)}` : "not known yet";
  byId("calibration-missing").hidden = !told.missing;
  byId("calibration-missing").textContent = told.missing;
  const helps = !told.missing && told.next && told.next.expected_error_mm < error.mean;
  byId("calibration-next").hidden = !helps;
  if (helps) byId("calibration-next").textContent = `With one more it would be ${inMm(told.next.expected_error_mm)}: ${told.next.words}.`;
}

/** Asks what all photos tell; where they contradict each other, that is told, and one can be removed. */
async function assess() {
  asked += 1;
  const mine = asked;
  show(null);
  const seen = photos.filter(({ refused }) => !refused).map(({ id }) => id);
  if (!seen.length && !table) return;
  const told = await post("calibration", { photos: seen, table: table?.id ?? null, place: place() });
  if (mine === asked) show(told);
}

/** The board in a photo, or why it cannot be used; the next photo is sent all the same. */
async function send(file) {
  const bar = byId("calibration-bar");
  const twins = [...photos, table].filter((each) => each?.file === file.name).length; // many phones call each photo image.jpg
  const name = `${file.name.slice(-NAME_MAX + 6)}${twins ? ` (${twins + 1})` : ""}`;
  const query = new URLSearchParams({ name, board: byId("calibration-board").value.trim() });
  bar.hidden = false;
  try {
    const sent = await upload(`calibration/photos?${query}`, file, (share) => { bar.value = share; }, "application/octet-stream");
    return { ...sent, file: file.name };
  } catch (error) {
    return { name, file: file.name, refused: error.message };
  } finally {
    bar.hidden = true;
  }
}

async function add(files, isTable) {
  for (const file of files) {
    const sent = await send(file);
    if (isTable && !sent.refused) table = sent;
    else photos.push(sent);
    show(null);
  }
  await assess();
}

function save() {
  const text = JSON.stringify(camera, null, 1);
  localStorage.setItem(KEPT, text);
  set("camera", camera);
  const link = el("a", { href: URL.createObjectURL(new Blob([text], { type: "application/json" })), download: "camera.json" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  byId("camera-saved").hidden = false;
}

function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEPT));
  } catch {
    return null;
  }
}

export function setUpCalibrate() {
  set("camera", kept());
  for (const [button, input, isTable] of [["add-board-photos", "board-photo-files", false], ["add-table-view", "table-view-file", true]]) {
    byId(button).addEventListener("click", () => byId(input).click());
    byId(input).addEventListener("change", async ({ target }) => {
      const files = [...target.files];
      target.value = "";
      if (mayDrive()) await act(byId(button), () => add(files, isTable));
    });
  }
  byId("board-place").addEventListener("submit", (event) => event.preventDefault());
  byId("board-place").addEventListener("change", () => { if (byId("board-place").reportValidity()) tellFailure(assess); });
  byId("save-camera").addEventListener("click", save);
}
