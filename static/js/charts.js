// Small charts over the steps of an episode, drawn by uPlot: lines, and stacked bars. The label says the latest values.
import { el } from "./dom.js";

const HEIGHT = 132;
const FEW = 5; // steps for which the axis has room at least
const BARS = uPlot.paths.bars({ size: [0.7, 18] });
const charts = new WeakMap();

const colour = (name) => () => getComputedStyle(document.documentElement).getPropertyValue(name);
const axis = (options) => ({ stroke: colour("--muted"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, font: "10px sans-serif", ...options });

/** A dashed line at the step one looks at. */
function drawMark(plot) {
  const { at } = charts.get(plot.root.parentElement) ?? {};
  if (!(at >= 0)) return;
  const x = plot.valToPos(at, "x", true);
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.strokeStyle = colour("--muted")();
  ctx.setLineDash([3, 2]);
  ctx.beginPath();
  ctx.moveTo(x, bbox.top);
  ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.restore();
}

function drop(node) {
  const kept = charts.get(node);
  kept?.resized.disconnect();
  kept?.plot.destroy();
  charts.delete(node);
}

/** Draws all charts again, in the colours of another theme. */
export function redrawCharts() {
  for (const node of document.querySelectorAll(".plot")) charts.get(node)?.plot.redraw();
}

/** The chart in an element, made anew when its curves are others; `isBars` gives bars half a step of room at either side. */
function chartIn(node, series, unit, isBars) {
  const key = series.map(({ label }) => label).join();
  const kept = charts.get(node);
  if (kept?.key === key) return kept;
  drop(node);
  const options = {
    width: Math.max(node.clientWidth, 100), height: HEIGHT, legend: { show: false }, cursor: { y: false, drag: { x: false } },
    padding: [10, 8, 0, 0],
    scales: {
      x: { time: false, range: (_, low, high) => (isBars ? [0.5, Math.max(high, FEW) + 0.5] : [0, Math.max(high, FEW)]) },
      y: { range: (_, low, high) => [0, Math.max(high * 1.05, 1e-9)] },
    },
    axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis({ size: 40, label: unit, labelSize: 12, labelFont: "10px sans-serif" })],
    series: [{}, ...series.map((line) => ({ label: line.label, stroke: line.colour, width: 1.8, fill: isBars ? line.colour : undefined, paths: isBars ? BARS : undefined, points: { show: !isBars, size: 4, fill: line.colour } }))],
    hooks: { draw: [drawMark] },
  };
  node.replaceChildren();
  const plot = new uPlot(options, [[]], node);
  const resized = new ResizeObserver(() => node.clientWidth && plot.setSize({ width: node.clientWidth, height: HEIGHT }));
  const chart = { key, plot, resized, at: -1 };
  charts.set(node, chart);
  resized.observe(node);
  return chart;
}

function draw(node, series, { unit, at, name, none }, isBars) {
  const steps = [...new Set(series.flatMap(({ values }) => values.map(([step]) => step)))].sort((a, b) => a - b);
  if (!steps.length) return empty(node, name, none);
  const chart = chartIn(node, series, unit, isBars);
  const rows = series.map(({ values }) => { const own = new Map(values); return steps.map((step) => own.get(step) ?? null); });
  // What is stacked is drawn from the highest sum down, so that each layer covers what is not its own.
  if (isBars) for (let i = rows.length - 2; i >= 0; i -= 1) rows[i] = rows[i].map((value, k) => value + rows[i + 1][k]);
  chart.at = at;
  chart.plot.setData([steps, ...rows]);
  const latest = series.filter((line) => line.values.length)
    .map((line) => `${line.label} ${Number(line.values.at(-1)[1].toPrecision(3))} ${unit}`);
  node.setAttribute("aria-label", `${name}; after step ${steps.at(-1)}: ${latest.join(", ")}`);
  return undefined;
}

/** Lines: [{ label, colour, values: [[step, value]] }]. */
export const drawLines = (node, series, options) => draw(node, series, options, false);

/** Stacked bars: [{ label, colour, values: [[step, value]] }], the same steps in each. */
export const drawBars = (node, series, options) => draw(node, series, options, true);

function empty(node, name, why = "comes with the first steps") {
  drop(node);
  node.replaceChildren(el("p", { className: "hint" }, why));
  node.setAttribute("aria-label", `${name}; ${why}`);
}

export function drawLegend(node, series) {
  node.replaceChildren(...series.map(({ label, colour: own }) => {
    const swatch = el("span", { className: "swatch" });
    swatch.style.background = own;
    return el("li", {}, swatch, label);
  }));
}

/** The step at a place on a chart over the steps up to `last`; null where there is no chart. */
export function stepAt(node, clientX, last) {
  const plot = charts.get(node)?.plot;
  if (!plot) return null;
  const step = Math.round(plot.posToVal(clientX - plot.over.getBoundingClientRect().left, "x"));
  return Math.min(Math.max(step, 0), last);
}
