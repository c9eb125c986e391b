// What an episode's steps amount to, as charts: how far things are, how alike the images, where the time goes.
import { drawBars, drawLegend, drawLines, stepAt } from "./charts.js";
import { COLOURS } from "./curves.js";
import { byId } from "./dom.js";
import { NOT_KNOWN, offsets } from "./run-summary.js";
import { labelOf } from "./state.js";

const STAGES = [["estimate", "look", COLOURS[0]], ["search", "search", COLOURS[4]], ["plan", "plan", COLOURS[1]], ["act", "act", COLOURS[2]]];
const MILLI = 1000;
const ACTION_S = 0.2;

const distance = (step, name) => offsets(step)?.[name];

function distances({ objects, steps }) {
  return objects.map((name, i) => ({
    label: labelOf(name), colour: COLOURS[i % COLOURS.length],
    values: steps.filter((step) => Number.isFinite(distance(step, name))).map((step) => [step.step, distance(step, name)]),
  }));
}

function times({ steps }) {
  const rounds = steps.filter(({ step }) => step > 0);
  return STAGES.filter(([stage]) => stage !== "search" || rounds.some((step) => step.seconds.search)).map(([stage, label, colour]) => ({
    label, colour, values: rounds.map((step) => [step.step, step.seconds[stage] ?? 0]),
  }));
}

/** How fast the rounds are against what they show: an action takes 0.2 s on the table. */
function realTime(spent) {
  const seconds = spent.flatMap(({ values }) => values).reduce((sum, [, value]) => sum + value, 0);
  return seconds ? `${((ACTION_S * spent[0].values.at(-1)[0]) / seconds).toPrecision(2)} × real time` : "";
}

/** Draws all charts, with a mark at the step one looks at. */
export function drawProgress(episode, at) {
  const { steps } = episode;
  const far = distances(episode);
  const isKnown = steps.length > 0 && offsets(steps[0]);
  const none = steps.length && !isKnown ? NOT_KNOWN : undefined;
  drawLines(byId("chart-distance"), far, { unit: "mm", at, name: "Distance to the goal", none });
  drawLegend(byId("key-distance"), none ? [] : far);
  byId("distance-kind").textContent = isKnown ? (steps[0].truly_to_goal_mm ? "true, of each object" : "as estimated, of each object") : "";
  const cost = steps.map(({ step, image_cost: value }) => [step, MILLI * value]);
  drawLines(byId("chart-cost"), [{ label: "image cost", colour: COLOURS[0], values: cost }], { unit: "10⁻³", at, name: "Image cost" });
  const spent = times(episode);
  drawBars(byId("chart-time"), spent, { unit: "s", at, name: "Time per step" });
  drawLegend(byId("key-time"), spent);
  const { first, goal } = steps[0]?.seconds ?? {};
  const before = [first && `first frame ${first.toFixed(0)} s`, goal && `goal image ${goal.toFixed(0)} s`];
  byId("first-seconds").textContent = [...before, realTime(spent)].filter(Boolean).join(", ");
}

/** A click on a chart goes to its step; `lastStep` tells how many there are. */
export function setUpProgress(lastStep, goTo) {
  for (const id of ["chart-distance", "chart-cost", "chart-time"]) {
    byId(id).addEventListener("click", (event) => {
      const step = stepAt(byId(id), event.clientX, lastStep());
      if (step !== null) goTo(step);
    });
  }
}
