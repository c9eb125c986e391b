// An estimator at work, drawn over the pictures that it looks at: what it tries, the best so far, and what it found. In
// the strip of cameras always; larger beside it, with the error and the lamp, while an episode that is on view looks.
import { COLOURS, svg } from "./curves.js";
import { byId, el } from "./dom.js";
import { imageOf } from "./goals.js";
import { LIVE } from "./jobs.js";
import { current, known, watch } from "./state.js";

const STAYS_MS = 4000; // how long a result stays drawn
const FOUND = "#35d07f";
const [WIDTH, HEIGHT] = [100, 40];
const SIDE = 256; // of a large picture [px]
const SIZE = 100; // of the lamp's sky: its rim is the horizon
const QUESTIONS = {
  first: "Which pose of each object, and which lamp, explain what the four cameras see?",
  goal: "Where does the photo show each object, and under which lamp was it taken?",
  search: "Something is not where it should be. Where is it now?",
};
const FOUR = ["0", "1", "2", "3"];
const places = []; // { camera, layer, picture }: the outlines, and the rendered estimate below them, over a picture
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
  byId("look-difference").textContent = `off by ${percent(differences.at(-1))}`;
}

function drawLamp([azimuth, elevation], isOver) {
  const angle = (azimuth * Math.PI) / 180;
  const r = SIZE * (1 - elevation / 90);
  const [x, y] = [r * Math.cos(angle), -r * Math.sin(angle)];
  const [, line, sun] = byId("look-lamp").children;
  line.setAttribute("x2", x);
  line.setAttribute("y2", y);
  sun.setAttribute("transform", `translate(${x} ${y})`);
  byId("look-light").textContent = `${isOver ? "Lamp found" : "Lamp"}: ${((azimuth + 360) % 360).toFixed(0)}°, ${elevation.toFixed(0)}° up`;
}

function clear() {
  for (const { layer, picture } of places) {
    layer.replaceChildren();
    picture.removeAttribute("src");
  }
  showLarge(false);
  differences = [];
  about = "";
}

// The large pictures

/** Whether the episode on view is the one that looks. */
const isOnView = () => LIVE.has(known("episode")?.state) && byId("shown").dataset.episode === known("episode").id;

function showLarge(on) {
  byId("looking").hidden = !on;
  byId("shown").classList.toggle("is-looking", on);
}

/** Another look begins: what it looks at. */
function begin(look) {
  const scene = current();
  const goal = known("goals").find(({ id }) => id === known("report")?.goal) ?? known("goal");
  byId("looking-what").textContent = QUESTIONS[look] ?? "";
  for (const tile of byId("looking-tiles").children) {
    const { camera } = tile.dataset;
    tile.hidden = (look === "goal") !== (camera === "goal");
    const query = new URLSearchParams({ size: SIDE, v: scene?.revision });
    const url = camera === "goal" ? goal && imageOf(goal) : scene && `api/scenes/${scene.id}/images/${camera}.png?${query}`;
    const base = tile.querySelector(".base");
    if (url && !tile.hidden) base.src = url;
    else base.removeAttribute("src");
  }
}

/** Draws one step of an estimator. */
export function showLook({ look, difference, is_over: isOver, cameras, pictures, light_deg: light }) {
  if (look === "next") return; // too short to be seen
  if (about !== look) {
    clear();
    begin(look);
  }
  about = look;
  clearTimeout(timer);
  for (const { camera, layer, picture } of places) {
    drawCamera(layer, cameras[camera] ?? [], isOver);
    if (pictures[camera]) picture.src = pictures[camera];
  }
  if (difference !== null) {
    differences.push(difference);
    drawCurve();
  }
  drawLamp(light, isOver);
  showLarge(isOnView());
  if (isOver) timer = setTimeout(clear, STAYS_MS);
}

/** What is drawn over a picture of a camera. */
function overlay(camera) {
  const layer = svg("svg", { viewBox: "0 0 100 100", class: "outlines", "aria-hidden": "true" });
  const picture = el("img", { className: "believed", alt: "" });
  places.push({ camera, layer, picture });
  return [picture, layer];
}

export function setUpLooks() {
  for (const image of document.querySelectorAll("#camera-strip img[data-camera]")) image.after(...overlay(image.dataset.camera));
  for (const camera of [...FOUR, "goal"]) {
    const label = camera === "goal" ? "The photo" : `Camera ${camera}`;
    const tile = el("figure", {}, el("span", { className: "seen" }, el("img", { className: "base", alt: label }), ...overlay(camera)),
      el("figcaption", { textContent: label }));
    tile.dataset.camera = camera;
    byId("looking-tiles").append(tile);
  }
  for (const what of ["episode", "estimate"]) {
    watch(what, () => {
      if (!LIVE.has(known("episode")?.state) && !LIVE.has(known("estimate")?.state)) clear();
    });
  }
}
