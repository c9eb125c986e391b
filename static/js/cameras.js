// The camera strip: live images from the event stream, masks and the goal view by request, a large view on click.
import { byId, el } from "./dom.js";
import { enlargeComparison, isComparing } from "./neural.js";
import { imageOf } from "./goals.js";
import { current, known, watch } from "./state.js";

const NAMES = ["0", "1", "2", "3", "goal"];
const tiles = new Map();
let showsMasks = false;
let largeCamera = null;

/** Loads the newest image asked for, one at a time, so that a fast scene never piles up requests. */
export class LatestImage {
  constructor(image) {
    this.image = image;
    this.busy = false;
    this.next = null;
    this.dropped = 0; // how often what was asked for was dropped
  }

  /** Lets nothing come that was asked for and is under way. */
  drop() {
    this.next = null;
    this.dropped += 1;
  }

  /** Shows no image. */
  clear() {
    this.drop();
    this.image.removeAttribute("src");
  }

  show(url) {
    this.next = url;
    if (!this.busy) this.#load();
  }

  async #load() {
    this.busy = true;
    while (this.next) {
      const { next: url, dropped } = this;
      this.next = null;
      const loader = new Image();
      loader.src = url;
      const isThere = await loader.decode().then(() => true, () => false); // not that of a scene that was deleted meanwhile
      if (dropped !== this.dropped) continue;
      if (isThere) this.image.src = url;
      else if (!this.next) this.image.removeAttribute("src"); // rather none than that of something else
    }
    this.busy = false;
  }
}

/** The goal camera's tile shows the goal, of a recording or else the chosen one: what the table looks like is beside it. */
const showsGoal = (camera) => camera === "goal" && (known("recorded") || (!showsMasks && Boolean(known("goal"))));
const labelOfTile = (name) => (name !== "goal" ? `Camera ${name}` : showsGoal(name) ? "Goal" : "Goal camera, now");

function url(scene, camera, size, { pusher = true } = {}) {
  if (showsGoal(camera) && known("goal")) return imageOf(known("goal"));
  const query = new URLSearchParams({ size, masks: showsMasks, pusher, v: scene.revision });
  return `api/scenes/${scene.id}/images/${camera}.png?${query}`;
}

function refresh(scene) {
  byId("camera-strip").querySelector(".of-goal").firstChild.nodeValue = labelOfTile("goal");
  for (const [name, tile] of tiles) {
    if (!scene) tile.latest.clear();
    else if (name === "goal" || showsMasks) tile.latest.show(url(scene, name, 128, { pusher: name !== "goal" }));
  }
  if (scene && largeCamera) large.show(url(scene, largeCamera, 512, { pusher: largeCamera !== "goal" }));
}

const large = new LatestImage(byId("camera-large"));

/** Shows the large view as what is on view now, live or recorded, would have it. */
function drawLarge() {
  const isRecorded = Boolean(known("recorded"));
  byId("camera-large").hidden = isRecorded;
  for (const [i, part] of [...byId("camera-dialog").querySelectorAll(".crop")].entries()) part.hidden = !isRecorded || NAMES[i] !== largeCamera;
}

function enlarge(name) {
  const scene = current();
  if (!scene && !known("recorded")) return;
  if (isComparing() && !known("recorded")) {
    enlargeComparison(name);
    return;
  }
  largeCamera = name;
  byId("camera-dialog-title").textContent = labelOfTile(name);
  byId("camera-large").alt = byId("camera-dialog-title").textContent;
  large.clear();
  drawLarge();
  refresh(scene);
  byId("camera-dialog").showModal();
}

export function showFrames({ scene, cameras }) {
  if (showsMasks || scene !== current()?.id) return;
  for (const [name, data] of Object.entries(cameras)) {
    const tile = tiles.get(name);
    tile?.latest.drop(); // it is older
    if (tile) tile.image.src = data;
  }
}

export function toggleMasks(on = !showsMasks) {
  if (isComparing()) return;
  showsMasks = on;
  byId("masks").checked = on;
  const scene = current();
  if (!scene) return;
  refresh(scene);
  // Without masks the live images come with the next change; until then the plain ones are asked for.
  if (!on) for (const [name, tile] of tiles) tile.latest.show(url(scene, name, 128, { pusher: name !== "goal" }));
}

export function setUpCameras() {
  for (const name of NAMES) {
    const label = name === "goal" ? "Goal view" : `Camera ${name}`;
    const image = el("img", { alt: label, width: 128, height: 128 });
    image.dataset.camera = name;
    const caption = el("span", { textContent: labelOfTile(name), className: name === "goal" ? "of-goal" : "" });
    const button = el("button", { type: "button", title: `Enlarge: ${label.toLowerCase()}` }, image, caption);
    button.addEventListener("click", () => enlarge(name));
    byId("camera-strip").append(button);
    tiles.set(name, { image, latest: new LatestImage(image) });
  }
  byId("camera-dialog").addEventListener("close", () => { largeCamera = null; });
  byId("masks").addEventListener("change", (event) => toggleMasks(event.target.checked));
  watch("recorded", (on) => {
    byId("cameras").classList.toggle("is-recorded", on);
    byId("cameras-title").textContent = on ? "Cameras, recorded" : "Cameras";
    drawLarge();
    refresh(current());
  });
  let shown = null;
  watch("goal", () => refresh(current()));
  watch("scene", (scene) => {
    refresh(scene);
    if (scene && scene.id !== shown && !showsMasks) {
      for (const [name, tile] of tiles) if (name !== "goal") tile.latest.show(url(scene, name, 128));
    }
    shown = scene?.id ?? null;
  });
}
