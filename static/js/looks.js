// An estimator at work, drawn over the pictures that it looks at: what it tries, the best so far, and what it found.
import { COLOURS, svg } from "./curves.js";
import { byId } from "./dom.js";
import { LIVE } from "./jobs.js";
import { known, watch } from "./state.js";

const STAYS_MS = 4000; // how long a result stays drawn
const FOUND = "#35d07f";
const [WIDTH, HEIGHT] = [100, 30];
const layers = new Map(); // camera -> its overlay, and the rendered estimate below it
let differences = []; // of this look, between the rendered estimate and the pictures
let about = "";
let timer = 0;

const percent = (share) => `${(100 * share).toFixed(1)} %`;
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

function drawCurve() {
  const least = Math.max(Math.min(...differences), 1e-6);
  const span = Math.log(Math.max(Math.max(...differences) / least, 1.5)); // the last steps are small ones
  const step = WIDTH / Math.max(differences.length - 1, 1);
  const line = differences.map((value, i) => `${(i * step).toFixed(1)},${(HEIGHT - 1 - (HEIGHT - 3) * (Math.log(Math.max(value, least) / least) / span)).toFixed(1)}`);
  byId("look-curve").replaceChildren(svg("polyline", { points: line.join(" ") }));
  byId("look-curve").setAttribute("aria-label", `Difference between the rendered estimate and the pictures, now ${percent(differences.at(-1))}`);
}

function clear() {
  for (const { layer, picture } of layers.values()) {
    layer.replaceChildren();
    picture.removeAttribute("src");
  }
  byId("look-error").hidden = true;
  differences = [];
}

/** Draws one step of an estimator. */
export function showLook({ look, difference, is_over: isOver, cameras, pictures, light_deg: [azimuth, elevation] }) {
  if (look === "next") return; // too short to be seen
  if (about !== look) clear();
  about = look;
  clearTimeout(timer);
  for (const [camera, { layer, picture }] of layers) {
    drawCamera(layer, cameras[camera] ?? [], isOver);
    if (pictures[camera]) picture.src = pictures[camera];
  }
  if (difference !== null) differences.push(difference);
  byId("look-error").hidden = differences.length < 2;
  if (difference !== null) byId("look-difference").textContent = `off by ${percent(difference)}`;
  byId("look-light").textContent = `lamp: ${((azimuth + 360) % 360).toFixed(0)}° round, ${elevation.toFixed(0)}° high`;
  drawCurve();
  if (isOver) timer = setTimeout(clear, STAYS_MS);
}

export function setUpLooks() {
  for (const image of document.querySelectorAll("#camera-strip img[data-camera]")) {
    const layer = svg("svg", { viewBox: "0 0 100 100", class: "outlines", "aria-hidden": "true" });
    const picture = document.createElement("img");
    Object.assign(picture, { className: "believed", alt: "" });
    image.after(picture, layer);
    layers.set(image.dataset.camera, { layer, picture });
  }
  watch("episode", () => {
    if (!LIVE.has(known("episode")?.state) && !LIVE.has(known("estimate")?.state)) clear();
  });
}
