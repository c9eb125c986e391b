// The pictures of a step: goal, now, estimate and difference, a wipe between the first two, and the cameras. Goal and now
// are over the 3D view as well, and the cameras in their strip and enlarged, while a recording is on view.
// They come as one image of two rows of four captioned tiles, of which each place shows its part.
import { LatestImage } from "./cameras.js";
import { byId, el } from "./dom.js";

const PARTS = [
  { part: "goal", label: "Goal", row: 0, column: 0 },
  { part: "now", label: "Now", row: 0, column: 1 },
  { part: "estimate", label: "Estimate, rendered", row: 0, column: 2 },
  { part: "difference", label: "Difference × 3", row: 0, column: 3 },
];
const CAMERAS = [0, 1, 2, 3].map((camera) => ({ part: `camera-${camera}`, label: `Camera ${camera}`, row: 1, column: camera }));
const all = []; // every image that shows a part of the frame
const alone = new Map(); // part -> image that stands in before there is a frame

const frame = new LatestImage({
  set src(url) {
    for (const image of all) image.src = url;
    document.body.classList.add("has-frame");
  },
  removeAttribute(name) {
    for (const image of all) image.removeAttribute(name);
    document.body.classList.remove("has-frame");
  },
});

/** A window onto one tile of the frame. */
function crop({ label, row, column }) {
  const image = el("img", { alt: label, className: "part-of-frame" });
  image.style.left = `${-100 * column}%`;
  image.style.top = `${-100 * ((16 + 208 * row) / 192)}%`; // a caption of 16 px is above each tile of 192
  all.push(image);
  return el("span", { className: "crop" }, image);
}

export function showFrame(url) {
  frame.show(url);
}

/** Takes the next step's frame beforehand, so that a film does not stutter. */
export function preload(url) {
  new Image().src = url;
}

/** Before the first frame: the goal image and what the goal camera sees. */
export function standIn({ goal, now }) {
  frame.clear();
  for (const [part, url] of Object.entries({ goal, now })) {
    const image = alone.get(part);
    image.hidden = !url;
    if (url) image.src = url;
    else image.removeAttribute("src");
  }
}

function showMode(mode) {
  byId("tiles").hidden = mode === "wipe";
  byId("wipe").hidden = mode !== "wipe";
  for (const tile of byId("tiles").children) tile.hidden = (tile.dataset.set === "cameras") !== (mode === "cameras");
}

export function setUpPictures() {
  for (const [set, parts] of Object.entries({ four: PARTS, cameras: CAMERAS })) {
    for (const part of parts) {
      const figure = el("figure", {}, crop(part), el("figcaption", { textContent: part.label }));
      Object.assign(figure.dataset, { set, part: part.part });
      byId("tiles").append(figure);
    }
  }
  for (const part of PARTS.slice(0, 2)) {
    const stand = el("img", { alt: "", className: "stand-in", hidden: true });
    stand.addEventListener("error", () => { stand.hidden = true; });
    alone.set(part.part, stand);
    byId(`pinned-${part.part}`).prepend(crop(part), stand);
  }
  const strip = [...CAMERAS, PARTS[0]];
  for (const [i, tile] of [...byId("camera-strip").children].entries()) tile.prepend(crop(strip[i]));
  byId("camera-dialog").append(...strip.map(crop));
  const [goal, now] = PARTS.slice(0, 2).map(crop);
  now.classList.add("over");
  byId("wipe-pair").append(goal, now);
  const wipe = () => { now.style.clipPath = `inset(0 ${byId("wipe-at").value}% 0 0)`; };
  byId("wipe-at").addEventListener("input", wipe);
  wipe();
  for (const radio of document.getElementsByName("picture-mode")) radio.addEventListener("change", () => showMode(radio.value));
  showMode("four");
}
