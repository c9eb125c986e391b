// Losses as curves. Each stage counts in units of its own, so every curve is drawn relative to its largest value in the stage.
import { el } from "./dom.js";

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT, FOOT] = [344, 132, 16];
export const COLOURS = ["#2a84c0", "#e07b2a", "#3a9a5b", "#c8486a", "#8b6fc9", "#9a7350", "#c75fa6", "#4aa3a3"];
const LETTER_PX = 5.6;

const colourOf = (number, count) => (number === count ? "var(--text)" : COLOURS[number % COLOURS.length]);

export function svg(tag, attributes, text = "") {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.textContent = text;
  return node;
}

/** Runs of steps of one stage: [{ stage, steps }]. */
function stagesOf(steps) {
  const stages = [];
  for (const step of steps) {
    if (stages.at(-1)?.stage !== step.stage) stages.push({ stage: step.stage, steps: [] });
    stages.at(-1).steps.push(step);
  }
  return stages.filter(({ stage }) => stage !== "done");
}

const known = (value) => value !== null && value !== undefined;

/** Where a curve goes within its stage; each loss in the middle of its step's share of the width. */
function points(steps, valueOf, x, width) {
  const values = steps.map(valueOf);
  const most = Math.max(...values.filter(known), 1e-300);
  const each = width / steps.length;
  return values.map((value, i) => (known(value)
    ? [x + (i + 0.5) * each, (HEIGHT - FOOT) - (HEIGHT - FOOT - 6) * (value / most)] : null)).filter(known);
}

function curve(at, colour, isWhole) {
  if (at.length === 1) return svg("circle", { cx: at[0][0], cy: at[0][1], r: 2.2, fill: colour });
  const path = at.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join(" L");
  return svg("path", { d: `M${path}`, fill: "none", stroke: colour, "stroke-width": isWhole ? 2.2 : 1.6, "stroke-linejoin": "round" });
}

/** Draws all steps into an SVG element, and says in its label how far the last ones are. */
export function drawCurves(node, names, steps) {
  const stages = stagesOf(steps);
  const total = stages.reduce((sum, { steps: own }) => sum + own.length, 0);
  node.replaceChildren();
  node.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  let x = 0;
  for (const [number, { stage, steps: own }] of stages.entries()) {
    const width = (WIDTH * own.length) / total;
    const back = svg("rect", { x, y: 0, width, height: HEIGHT - FOOT, class: number % 2 ? "stage-odd" : "stage-even" });
    back.append(svg("title", {}, stage));
    node.append(back);
    if (width > stage.length * LETTER_PX) node.append(svg("text", { x: x + width / 2, y: HEIGHT - 4, class: "stage-name" }, stage));
    for (let object = 0; object <= names.length; object += 1) {
      const at = points(own, (step) => (object === names.length ? step.loss : step.losses[object]), x, width);
      if (at.length) node.append(curve(at, colourOf(object, names.length), object === names.length));
    }
    x += width;
  }
  const last = stages.at(-1);
  node.setAttribute("aria-label", last ? `Losses of ${total} steps; now ${last.stage}` : "No losses yet");
}

/** The key to the curves' colours. */
export function drawKey(node, labels) {
  const entries = [...labels, "whole"].map((label, number) => {
    const swatch = el("span", { className: "swatch" });
    swatch.style.background = colourOf(number, labels.length);
    return el("li", {}, swatch, label);
  });
  node.replaceChildren(...entries);
}
