// A picture or a mesh may be dropped anywhere on the page: over the 3D view, too, whose frame would swallow it.
import { byId } from "./dom.js";
import { isMesh, takeMesh } from "./own-object.js";
import { sendPicture } from "./picture.js";

const AWAY_MS = 150; // a drag that is over the page tells so more often than this
let timer = 0;

const hasFiles = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");

function show(on) {
  byId("dropping").hidden = !on;
  byId("goal-drop").classList.toggle("over", on);
}

function over(event) {
  if (!hasFiles(event)) return;
  event.preventDefault(); // else the browser opens what is dropped
  show(true);
  clearTimeout(timer);
  timer = setTimeout(() => show(false), AWAY_MS);
}

function drop(event) {
  if (!hasFiles(event)) return;
  event.preventDefault();
  show(false);
  const [file] = event.dataTransfer.files;
  if (!file) return;
  if (isMesh(file)) takeMesh(file);
  else sendPicture(file);
}

function listenIn(target) {
  for (const kind of ["dragenter", "dragover"]) target.addEventListener(kind, over);
  target.addEventListener("drop", drop);
}

export function setUpDrop() {
  listenIn(window);
  const frame = byId("viewer");
  frame.addEventListener("load", () => { if (frame.contentWindow) listenIn(frame.contentWindow); });
}
