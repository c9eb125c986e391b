// Boxes around the objects on a robot's table, dragged in its pictures, where the robot does not tell which pixels are whose.
import { svg } from "./curves.js";
import { byId, el } from "./dom.js";
import { known, labelOf, watch } from "./state.js";

const LEAST_PX = 4;
const boxes = new Map(); // by camera: a map of boxes by object
let names = []; // objects on the table
let drag = null; // {from, to, pointer}
let tell = () => {};

const cameras = () => known("robot")?.cameras ?? [];
const camera = () => cameras().find(({ name }) => name === byId("robot-box-camera").value);
const of = (name) => boxes.get(name) ?? new Map();
const boxOf = ([x0, y0], [x1, y1]) => [Math.min(x0, x1), Math.min(y0, y1), Math.max(x0, x1), Math.max(y0, y1)];
const without = (cameraName) => names.filter((name) => !of(cameraName).has(name));

/** Whether boxes are needed around these objects. */
const isNeeded = () => names.length > 0 && cameras().length > 0 && !names.every((name) => known("robot").masks.includes(name));

/** What is still to be done, a sentence; "" if nothing is. */
export function missingBoxes() {
  if (!isNeeded() || cameras().some(({ name }) => !without(name).length)) return "";
  return `Draw a box around ${without(camera()?.name).map(labelOf).join(", ")} in the picture.`;
}

/** The boxes as REST takes them: by camera and object. */
export function drawnBoxes() {
  if (!isNeeded()) return {};
  const all = [...boxes].map(([name, its]) => [name, Object.fromEntries([...its].filter(([object]) => names.includes(object)))]);
  return Object.fromEntries(all.filter(([, its]) => Object.keys(its).length));
}

/** After an episode things lie elsewhere. */
export function forgetBoxes() {
  boxes.clear();
  draw();
}

/** Which objects lie on the table. */
export function boxesFor(chosen) {
  names = chosen;
  draw();
}

function shape(name, [left, top, right, bottom]) {
  const size = camera().width / 24;
  const label = svg("text", { x: left, y: Math.max(top - size / 4, size), class: "photo-name", "font-size": size }, name);
  return [svg("rect", { x: left, y: top, width: right - left, height: bottom - top, class: "photo-box" }), label];
}

function drawPicture() {
  const its = camera();
  const picture = its && known("robotPictures")[its.name];
  if (!picture) return;
  const [canvas, image] = [byId("robot-boxes-svg"), byId("robot-boxes-image")];
  canvas.setAttribute("viewBox", `0 0 ${its.width} ${its.height}`);
  for (const [key, value] of [["width", its.width], ["height", its.height], ["href", picture]]) {
    if (image.getAttribute(key) !== String(value)) image.setAttribute(key, value);
  }
  const drawn = [...of(its.name)].filter(([name]) => names.includes(name)).flatMap(([name, box]) => shape(labelOf(name), box));
  byId("robot-boxes-drawn").replaceChildren(...drawn, ...(drag ? shape(labelOf(byId("robot-box-object").value), boxOf(drag.from, drag.to)) : []));
}

function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([value, textContent]) => el("option", { value, textContent, selected: value === chosen })));
}

function draw() {
  byId("robot-boxes").hidden = !isNeeded();
  if (byId("robot-boxes").hidden) return;
  fill(byId("robot-box-camera"), cameras().map(({ name }) => [name, name]), byId("robot-box-camera").value || cameras()[0].name);
  fill(byId("robot-box-object"), names.map((name) => [name, labelOf(name)]), byId("robot-box-object").value || names[0]);
  drawPicture();
}

function at(event) {
  const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(byId("robot-boxes-svg").getScreenCTM().inverse());
  const { width, height } = camera();
  return [Math.min(Math.max(x, 0), width), Math.min(Math.max(y, 0), height)].map(Math.round);
}

/** Keeps the box that was dragged; the next object without one is chosen then. */
function keep() {
  const box = boxOf(drag.from, drag.to);
  drag = null;
  if (box[2] - box[0] >= LEAST_PX && box[3] - box[1] >= LEAST_PX) {
    const { name } = camera();
    boxes.set(name, of(name).set(byId("robot-box-object").value, box));
    byId("robot-box-object").value = without(name)[0] ?? names[0];
    tell();
  }
  drawPicture();
}

/** `onBox` is called with every box that was drawn. */
export function setUpRobotBoxes(onBox) {
  tell = onBox;
  const canvas = byId("robot-boxes-svg");
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button || drag || !camera()) return;
    canvas.setPointerCapture(event.pointerId);
    drag = { from: at(event), to: at(event), pointer: event.pointerId };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (event.pointerId !== drag?.pointer) return;
    drag.to = at(event);
    drawPicture();
  });
  canvas.addEventListener("pointerup", (event) => { if (event.pointerId === drag?.pointer) keep(); });
  canvas.addEventListener("pointercancel", () => { drag = null; drawPicture(); });
  byId("robot-box-camera").addEventListener("change", () => { drawPicture(); tell(); });
  watch("robotPictures", drawPicture);
}
