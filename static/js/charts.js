// Small charts over the steps of an episode: lines, and stacked bars. Axes carry units; the label says the latest values.
import { svg } from "./curves.js";
import { el } from "./dom.js";

const [WIDTH, HEIGHT] = [364, 124];
const [LEFT, RIGHT, TOP, BOTTOM] = [34, 8, 17, 20];
const TICKS = 4;
const FEW = 5; // steps for which the axis has room at least

/** Round steps for an axis from 0 to `most`. */
function ticks(most, count = TICKS) {
  const raw = most / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= raw * (1 - 1e-9));
  const all = [];
  for (let i = 0; i * step < most * (1 + 1e-9) || i < 2; i += 1) all.push(Number((i * step).toPrecision(6)));
  return all;
}

/** Which steps an axis shows: bars begin with the first action and need half a step at either side. */
const span = (last, isBars) => (isBars ? [0.5, Math.max(last, FEW) + 0.5] : [0, Math.max(last, FEW)]);

class Plot {
  constructor(node, { most, last, unit, isBars = false }) {
    this.node = node;
    [this.first, this.end] = span(last, isBars);
    this.marks = ticks(Math.max(most, 1e-9) * 1.02);
    this.top = Math.max(this.marks.at(-1), most);
    node.replaceChildren();
    node.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    for (const value of this.marks) {
      node.append(svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: this.y(value), y2: this.y(value), class: "plot-grid" }));
      node.append(svg("text", { x: LEFT - 4, y: this.y(value) + 3.2, class: "plot-y" }, String(value)));
    }
    node.append(svg("text", { x: LEFT - 4, y: TOP - 8, class: "plot-unit" }, unit));
    for (const step of ticks(this.end, 6).filter((s) => Number.isInteger(s) && s >= this.first && s <= this.end)) {
      node.append(svg("text", { x: this.x(step), y: HEIGHT - 6, class: "plot-x" }, String(step)));
    }
    node.append(svg("text", { x: LEFT - 6, y: HEIGHT - 6, class: "plot-unit" }, "step"));
  }

  x(step) {
    return LEFT + 4 + ((WIDTH - LEFT - RIGHT - 8) * (step - this.first)) / (this.end - this.first);
  }

  y(value) {
    return HEIGHT - BOTTOM - ((HEIGHT - BOTTOM - TOP) * value) / this.top;
  }

  /** Where in the episode one looks. */
  mark(step) {
    if (step >= this.first) this.node.append(svg("line", { x1: this.x(step), x2: this.x(step), y1: TOP, y2: HEIGHT - BOTTOM, class: "plot-at" }));
  }
}

/** Lines: [{ label, colour, values: [[step, value]] }]. */
export function drawLines(node, series, { unit, at, name }) {
  const values = series.flatMap((line) => line.values);
  if (!values.length) return empty(node, name);
  const [most, last] = [1, 0].map((place) => Math.max(...values.map((pair) => pair[place])));
  const plot = new Plot(node, { most, last, unit });
  plot.mark(at);
  for (const { colour, values: own } of series) {
    const points = own.map(([step, value]) => [plot.x(step), plot.y(value)]);
    const path = points.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join(" L");
    node.append(svg("path", { d: `M${path}`, class: "plot-line", stroke: colour }));
    const dot = points[own.findIndex(([step]) => step === at)] ?? points.at(-1);
    if (dot) node.append(svg("circle", { cx: dot[0], cy: dot[1], r: 2.6, fill: colour }));
  }
  const latest = series.filter((line) => line.values.length)
    .map((line) => `${line.label} ${Number(line.values.at(-1)[1].toPrecision(3))} ${unit}`);
  node.setAttribute("aria-label", `${name}; after step ${values.at(-1)[0]}: ${latest.join(", ")}`);
  return undefined;
}

/** Stacked bars: [{ label, colour, values: [[step, value]] }], the same steps in each. */
export function drawBars(node, series, { unit, at, name }) {
  const steps = series[0]?.values.map(([step]) => step) ?? [];
  if (!steps.length) return empty(node, name);
  const sums = steps.map((_, i) => series.reduce((sum, layer) => sum + layer.values[i][1], 0));
  const plot = new Plot(node, { most: Math.max(...sums), last: steps.at(-1), unit, isBars: true });
  plot.mark(at);
  const width = Math.max(0.7 * Math.min(plot.x(2) - plot.x(1), 18), 1);
  for (const [i, step] of steps.entries()) {
    let below = 0;
    for (const { label, colour, values } of series) {
      const value = values[i][1];
      const y = plot.y(below + value);
      const bar = svg("rect", { x: plot.x(step) - width / 2, width, y, height: Math.max(plot.y(below) - y, 0), fill: colour });
      bar.append(svg("title", {}, `${label}: ${value.toFixed(2)} ${unit}`));
      node.append(bar);
      below += value;
    }
  }
  const latest = series.map((layer) => `${layer.label} ${layer.values.at(-1)[1].toFixed(2)} ${unit}`);
  node.setAttribute("aria-label", `${name}; step ${steps.at(-1)}: ${latest.join(", ")}`);
  return undefined;
}

function empty(node, name) {
  node.replaceChildren(svg("text", { x: WIDTH / 2, y: HEIGHT / 2, class: "plot-empty" }, "comes with the first steps"));
  node.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  node.setAttribute("aria-label", `${name}; no steps yet`);
}

export function drawLegend(node, series) {
  node.replaceChildren(...series.map(({ label, colour }) => {
    const swatch = el("span", { className: "swatch" });
    swatch.style.background = colour;
    return el("li", {}, swatch, label);
  }));
}

/** The step at a place on a chart over the steps up to `last`. */
export function stepAt(node, clientX, last, isBars) {
  const box = node.getBoundingClientRect();
  const [first, end] = span(last, isBars);
  const share = (((clientX - box.left) / box.width) * WIDTH - LEFT - 4) / (WIDTH - LEFT - RIGHT - 8);
  return Math.min(Math.max(Math.round(first + share * (end - first)), Math.ceil(first)), last);
}
