// The photo over the 3D view: a box is dragged around an object; clicks and a brush mend its mask. All in pixels of the photo.
import { svg } from "./curves.js";
import { byId } from "./dom.js";

const CLICK_PX = 4; // of the page: what moves less than that is a click
const LEAST_BOX = 8;
const MOST_POINTS = 400; // of one stroke

let photo = null;
let chosen = "";
let tool = "box";
let brush = 12;
let drag = null; // {points, from: where it began on the page}

const stage = () => byId("photo-stage");
const polygon = (points) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`;
const tenth = (value) => Math.round(10 * value) / 10;
const clamp = ([x, y]) => [tenth(Math.min(Math.max(x, 0), photo.width)), tenth(Math.min(Math.max(y, 0), photo.height))];
const unit = () => 1 / (byId("photo-svg").getScreenCTM()?.a ?? 1); // a pixel of the page

/** Where a pointer is in the photo. */
function at(event) {
  const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(byId("photo-svg").getScreenCTM().inverse());
  return clamp([place.x, place.y]);
}

const boxOf = (points) => {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
};

function rect([left, top, right, bottom]) {
  return svg("rect", { x: left, y: top, width: right - left, height: bottom - top, class: "photo-box" });
}

function marksOf(object) {
  const isChosen = object.name === chosen;
  const [left, top] = object.box;
  const name = svg("text", { x: left + 4 * unit(), y: Math.max(top - 6 * unit(), 16 * unit()), class: "photo-name", "font-size": 14 * unit() });
  name.textContent = object.label;
  const shown = object.found?.outline.length ? object.found.outline : object.outline;
  const outline = svg("path", { d: shown.map(polygon).join(""), class: `photo-outline${isChosen ? " chosen" : ""}` });
  if (!isChosen) return [outline, name];
  const clicks = [...object.on.map((p) => [p, "on"]), ...object.off.map((p) => [p, "off"])].map(([[x, y], kind]) =>
    svg("circle", { cx: x, cy: y, r: 5 * unit(), class: `photo-click ${kind}` }));
  return [outline, rect(object.box), ...clicks, name];
}

/** Draws a photo, and what is marked in it; null takes it away. */
export function drawMarks(next, name) {
  const isAnother = next?.id !== photo?.id;
  photo = next;
  chosen = name;
  if (!photo) return;
  if (isAnother) {
    byId("photo-svg").setAttribute("viewBox", `0 0 ${photo.width} ${photo.height}`);
    for (const id of ["photo-image", "photo-drawing"]) {
      byId(id).setAttribute("width", photo.width);
      byId(id).setAttribute("height", photo.height);
    }
  }
  const picture = `api/photos/${photo.id}/photo.jpg?${new URLSearchParams({ focal: photo.focal_px })}`; // its lens may be another one
  if (byId("photo-image").getAttribute("href") !== picture) byId("photo-image").setAttribute("href", picture);
  drawObjects();
}

function drawObjects() {
  byId("photo-outlines").replaceChildren(...(photo?.objects.flatMap(marksOf) ?? []));
}

/** Shows what was found, drawn from the photo's camera; "" where nothing is to be shown. */
export function setDrawing(url) {
  byId("photo-wipe").hidden = !url;
  if (!url) {
    byId("photo-drawing").removeAttribute("href");
    byId("photo-wipe-at").value = 0;
  } else if (byId("photo-drawing").getAttribute("href") !== url) byId("photo-drawing").setAttribute("href", url);
  wipe();
}

/** Wipes from the photo to the drawing and back. */
export function wipeTo(percent) {
  byId("photo-wipe-at").value = percent;
  wipe();
}

function wipe() {
  if (!photo) return;
  const share = byId("photo-wipe-at").value / 100;
  byId("photo-clip-rect").setAttribute("width", share * photo.width);
  byId("photo-clip-rect").setAttribute("height", photo.height);
  byId("photo-outlines").style.opacity = share > 0 ? 0.25 : 1;
}

export const setTool = (name) => { tool = name; };
export const setBrush = (radius) => { brush = radius; };
export const setBusy = (isBusy) => stage().classList.toggle("busy", isBusy);

function draw() {
  const { points } = drag;
  if (tool === "box") byId("photo-drawn").replaceChildren(rect(boxOf(points)));
  else {
    const line = svg("polyline", { points: points.map((p) => p.join()).join(" "), class: `photo-stroke ${tool}` });
    line.style.strokeWidth = 2 * brush * unit();
    byId("photo-drawn").replaceChildren(line);
  }
}

/** A stroke with at most so many points. */
function thinned(points) {
  const step = Math.ceil(points.length / MOST_POINTS);
  return points.filter((_, number) => number % step === 0 || number === points.length - 1);
}

/** What a person does with the pointer goes to `onBox(box)`, `onClick(point, tool)` and `onStroke(points, radius, tool)`. */
export function setUpMarks({ onBox, onClick, onStroke }) {
  const canvas = byId("photo-svg");
  canvas.addEventListener("pointerdown", (event) => {
    if (!photo || event.button || drag) return;
    wipeTo(0); // or one would mark what is not there
    canvas.setPointerCapture(event.pointerId);
    drag = { points: [at(event)], from: event };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (event.pointerId !== drag?.from.pointerId) return;
    drag.points.push(at(event));
    draw();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (event.pointerId !== drag?.from.pointerId) return;
    const { points, from } = drag;
    drag = null;
    byId("photo-drawn").replaceChildren();
    const isClick = Math.hypot(event.clientX - from.clientX, event.clientY - from.clientY) < CLICK_PX && points.length < 8;
    if (isClick) onClick(points[0], tool);
    else if (tool !== "box") onStroke(thinned(points), brush * unit(), tool);
    else {
      const box = boxOf([points[0], points.at(-1)]);
      if (Math.min(box[2] - box[0], box[3] - box[1]) >= LEAST_BOX) onBox(box);
    }
  });
  canvas.addEventListener("pointercancel", () => {
    drag = null;
    byId("photo-drawn").replaceChildren();
  });
  new ResizeObserver(drawObjects).observe(canvas); // names keep the size of the page's words
  byId("photo-wipe-at").addEventListener("input", wipe);
  byId("photo-drawing").addEventListener("error", () => setDrawing(""));
}
