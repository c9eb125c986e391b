// Camera images beside what the fields render: observed, rendered, difference, with the PSNR of each camera.
import { problemOf } from "./api.js";
import { byId, el } from "./dom.js";
import { current, watch } from "./state.js";

const PARTS = ["observed", "rendered", "difference"];
const HINT = byId("cameras-hint").textContent;
const tiles = new Map();
let isOn = false;
let largeCamera = null;

/** Fetches the newest comparison asked for, one at a time, and hands it on as {url, psnr} or {problem}. */
class LatestComparison {
  constructor(show) {
    this.show = show;
    this.busy = false;
    this.next = null;
    this.url = null;
  }

  ask(url) {
    this.next = url;
    if (!this.busy) this.#load();
  }

  drop() {
    this.next = null;
    this.#keep(null);
  }

  #keep(url) {
    if (this.url) URL.revokeObjectURL(this.url);
    this.url = url;
  }

  async #load() {
    this.busy = true;
    while (this.next) {
      const url = this.next;
      this.next = null;
      try {
        const answer = await fetch(url);
        const found = answer.ok ? await answer.blob() : await problemOf(answer);
        if (!isOn) continue; // switched off while it was on its way
        if (answer.ok) {
          this.#keep(URL.createObjectURL(found));
          this.show({ url: this.url, psnr: Number(answer.headers.get("X-PSNR-dB")) });
        } else {
          this.show({ problem: answer.status === 404 ? "" : found }); // 404: deleted meanwhile
        }
      } catch {
        // The service is gone; the status line says so.
      }
    }
    this.busy = false;
  }
}

function url(scene, camera, size) {
  const query = new URLSearchParams({ kind: "comparison", size, pusher: camera !== "goal", v: scene.revision });
  return `api/scenes/${scene.id}/neural/${camera}.png?${query}`;
}

const label = (camera) => (camera === "goal" ? "Goal view" : `Camera ${camera}`);

function tell(text, isProblem = false) {
  byId("cameras-hint").textContent = text;
  byId("cameras-hint").classList.toggle("missing", isProblem);
}

function showTile(tile, { url, psnr, problem }) {
  if (problem !== undefined) {
    for (const image of tile.images) image.removeAttribute("src");
    tile.psnr.textContent = "";
    if (problem) tell(problem, true);
    return;
  }
  for (const image of tile.images) image.src = url;
  tile.psnr.textContent = `${psnr.toFixed(1)} dB`;
  tell("From above: what the camera sees, what the fields render, their difference\u00a0×\u00a04.");
}

const large = new LatestComparison(({ url, psnr }) => {
  if (!url || !largeCamera) return;
  byId("compare-large").src = url;
  byId("compare-dialog-title").textContent = `${label(largeCamera)}: ${psnr.toFixed(1)} dB`;
});

function refresh(scene) {
  if (!isOn) return;
  for (const [camera, tile] of tiles) {
    if (scene) tile.latest.ask(url(scene, camera, 128));
    else showTile(tile, { problem: "" });
  }
  if (scene && largeCamera) large.ask(url(scene, largeCamera, 384));
}

function toggle(on) {
  isOn = on;
  byId("camera-strip").classList.toggle("comparing", on);
  byId("masks").disabled = on;
  tell(on ? "Rendering; the first time, the renderer loads for up to half a minute." : HINT);
  for (const tile of tiles.values()) {
    if (on) continue;
    tile.latest.drop();
    showTile(tile, { problem: "" });
  }
  refresh(current());
}

export const isComparing = () => isOn;

export function enlargeComparison(camera) {
  largeCamera = camera;
  byId("compare-dialog-title").textContent = label(camera);
  byId("compare-large").removeAttribute("src");
  refresh(current());
  byId("compare-dialog").showModal();
}

/** Adds to each camera's tile what is shown in place of its image while comparing. */
export function setUpNeural() {
  for (const button of byId("camera-strip").children) {
    const camera = button.querySelector("img").dataset.camera;
    const images = PARTS.map((part) => el("img", { alt: `${label(camera)}, ${part}`, className: `part ${part}` }));
    const psnr = el("span", { className: "psnr" });
    button.querySelector("span").append(psnr);
    button.append(el("span", { className: "compared" }, ...images));
    const tile = { images, psnr };
    tile.latest = new LatestComparison((found) => showTile(tile, found));
    tiles.set(camera, tile);
  }
  byId("compare").addEventListener("change", (event) => toggle(event.target.checked));
  byId("compare-dialog").addEventListener("close", () => { largeCamera = null; });
  watch("scene", refresh);
}
