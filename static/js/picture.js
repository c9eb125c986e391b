// One way in for any picture: one of the goal camera becomes the goal, a photograph opens so that objects can be marked.
import { ApiError, problemOf, put, upload } from "./api.js";
import { openCrop } from "./crop.js";
import { byId, shareOn, whileDisabled } from "./dom.js";
import { mayDrive } from "./driver.js";
import { takeGoal } from "./goals.js";
import { findObjects, showPhoto } from "./photo.js";
import { known } from "./state.js";
import { showTab } from "./tabs.js";
import { act, tellFailure } from "./toasts.js";

const NAME_MAX = 100;

function send(path, file, onProgress) {
  const query = new URLSearchParams({ name: file.name.slice(-NAME_MAX) });
  return upload(`${path}?${query}`, file, onProgress, "application/octet-stream");
}

function useGoal(goal) {
  showTab("episode");
  byId("goal-card").open = true;
  takeGoal(goal);
}

/** Sends a picture, whatever it is; what is wrong with it is the service's to say. */
export async function sendPicture(file) {
  if (!mayDrive()) return;
  if (byId("panel-photo").hidden) showTab("episode");
  const isHere = byId("panel-photo").hidden;
  const bar = byId(isHere ? "goal-bar" : "table-photo-bar");
  byId("goal-card").open = true;
  bar.hidden = false;
  bar.value = 0;
  await tellFailure(async () => {
    const { goal, photo } = await send("pictures", file, shareOn(bar));
    if (photo) {
      await showPhoto(photo.id);
      return;
    }
    useGoal(goal);
    if (goal.photo.width !== goal.photo.height) openCrop(); // its middle is a guess
  }, byId(isHere ? "upload-goal" : "upload-table-photo"));
  bar.hidden = true;
}

async function fileOf(address, name) {
  const answer = await fetch(address);
  if (!answer.ok) throw new ApiError(await problemOf(answer), answer.status);
  return new File([await answer.blob()], name, { type: "image/jpeg" });
}

/** A photograph is cropped to what the goal camera would see. */
async function cropPhoto() {
  const { id, name } = known("photo");
  useGoal(await send("goals", await fileOf(`api/photos/${encodeURIComponent(id)}/photo.jpg`, name)));
  openCrop();
}

/** Objects are looked for in the photo of a goal. */
async function markGoal() {
  const { id, name } = known("goal");
  const photo = await send("photos", await fileOf(`api/goals/${encodeURIComponent(id)}/photo.jpg`, name));
  await showPhoto(photo.id);
}

/** A photo that comes with the page is sent, marked as its boxes say, and looked at. */
async function trySample() {
  if (!mayDrive()) return;
  const photo = await send("photos", await fileOf("samples/table.jpg", "Sample photo"));
  const boxes = await (await fetch("samples/table.json")).json();
  for (const [name, box] of Object.entries(boxes)) {
    await put(`photos/${photo.id}/objects/${name}`, { box, on: [], off: [], strokes: [] });
  }
  await showPhoto(photo.id);
  await findObjects();
}

export function setUpPicture() {
  const file = byId("goal-file");
  const button = byId("upload-goal");
  for (const opens of [byId("goal-drop"), button, byId("story-photo")]) opens.addEventListener("click", () => file.click());
  file.addEventListener("change", () => {
    const [chosen] = file.files;
    if (chosen) whileDisabled(button, () => sendPicture(chosen));
    file.value = "";
  });
  byId("sample-photo").addEventListener("click", () => act(byId("sample-photo"), trySample));
  byId("photo-crop").addEventListener("click", () => act(byId("photo-crop"), cropPhoto));
  byId("check-mark").addEventListener("click", () => act(byId("check-mark"), markGoal));
}
