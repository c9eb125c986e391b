// An estimator at work, drawn over the pictures that it looks at: what it tries, the best so far, and what it found.
import { COLOURS, svg } from "./curves.js";
import { byId } from "./dom.js";
import { LIVE } from "./jobs.js";
import { known, watch } from "./state.js";

const STAYS_MS = 4000; // how long a result stays drawn
const FOUND = "#35d07f";
const [WIDTH, HEIGHT] = [100, 30];
const layers = new Map(); // camera -> its overlay
let losses = []; // of this look: [stage, loss]
let about = "";
let timer = 0;

const points = (polygon) => polygon.map(([x, y]) => `${(100 * x).toFixed(2)},${(100 * y).toFixed(2)}`).join(" ");

function polygon(outline, className, colour) {
  const node = svg("polygon", { points: points(outline), class: className });
  node.style.stroke = colour;
  return node;
}

function drawCamera(layer, objects, isOver) {
  layer.replaceChildren(...objects.flatMap(({ best, tried }, i) => {
    const colour = COLOURS[i % COLOURS.length];
    return [...tried.map((outline) => polygon(outline, "tried", colour)), polygon(best, isOver ? "best locked" : "best", isOver ? FOUND : colour)];
  }));
}

/** Each stage has units of its own: every curve is drawn relative to its largest value. */
function drawCurve() {
  const most = new Map();
  for (const [stage, loss] of losses) most.set(stage, Math.max(most.get(stage) ?? 0, loss));
  const step = WIDTH / Math.max(losses.length - 1, 1);
  const line = losses.map(([stage, loss], i) => `${(i * step).toFixed(1)},${(HEIGHT - (HEIGHT - 2) * (loss / (most.get(stage) || 1))).toFixed(1)}`);
  byId("look-curve").replaceChildren(svg("polyline", { points: line.join(" ") }));
  byId("look-curve").setAttribute("aria-label", `Error of the estimate, ${losses.length} steps so far`);
}

function clear() {
  for (const layer of layers.values()) layer.replaceChildren();
  byId("look-error").hidden = true;
  losses = [];
}

/** Draws one step of an estimator. */
export function showLook({ look, loss, stage, is_over: isOver, cameras, light_deg: [azimuth, elevation] }) {
  if (look === "next") return; // too short to be seen
  if (about !== look) clear();
  about = look;
  clearTimeout(timer);
  for (const [camera, layer] of layers) drawCamera(layer, cameras[camera] ?? [], isOver);
  if (loss !== null) losses.push([stage, loss]);
  byId("look-error").hidden = losses.length < 2;
  byId("look-light").textContent = `lamp: ${((azimuth + 360) % 360).toFixed(0)}° round, ${elevation.toFixed(0)}° high`;
  drawCurve();
  if (isOver) timer = setTimeout(clear, STAYS_MS);
}

export function setUpLooks() {
  for (const image of document.querySelectorAll("#camera-strip img[data-camera]")) {
    const layer = svg("svg", { viewBox: "0 0 100 100", class: "outlines", "aria-hidden": "true" });
    image.after(layer);
    layers.set(image.dataset.camera, layer);
  }
  watch("episode", () => {
    if (!LIVE.has(known("episode")?.state) && !LIVE.has(known("estimate")?.state)) clear();
  });
}
