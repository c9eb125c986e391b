// Two runs side by side: what they came to, the settings in which they differ, their tables at the same step, and the
// distance of the farthest object; and running one again with other settings.
import { asked, note } from "./address.js";
import { get, post } from "./api.js";
import { drawLegend, drawLines } from "./charts.js";
import { COLOURS } from "./curves.js";
import { byId, el } from "./dom.js";
import { mayDrive } from "./driver.js";
import { takeSettings } from "./episode-settings.js";
import { LIVE } from "./jobs.js";
import { NOT_KNOWN, farthest, offsets, parts, roundAt } from "./run-summary.js";
import { resetScene } from "./scenes.js";
import { current, known, set } from "./state.js";
import { scrollTo } from "./tabs.js";
import { act, tellFailure, toast } from "./toasts.js";

const MOST = 100; // that are offered
const SETTINGS = {
  method: "Method",
  cost: "Cost", horizon: "Horizon, actions", samples: "Samples", temperature: "Temperature", steps: "Pushes at most",
  replan_every: "Replan every, actions", planning: "Plan", acting: "Act", despite_doubts: "Despite doubts",
};
let mine = null;
let other = null;
let at = 0; // the round of mine that is on view
let offeredFor = ""; // the episode for which the list was fetched

const path = (id) => `episodes/${encodeURIComponent(id)}`;
const told = (value) => ({ true: "yes", false: "no", paper: "as published" })[value] ?? String(value);

/** The other episodes that have steps, those toward the same goal first. */
async function offer() {
  if (!mine || offeredFor === mine.id) return;
  offeredFor = mine.id;
  const { episodes } = await get(`episodes?limit=${MOST}`);
  const others = episodes.filter(({ id, done, status }) => id !== mine.id && done > 0 && !LIVE.has(status));
  const isRival = ({ goal, scene }) => goal === mine.goal && scene === mine.scene;
  const option = (episode) => el("option", {
    value: episode.id, textContent: `${episode.name}: ${episode.settings.method === "paper" ? "as published" : `${episode.settings.cost} cost`}, ${episode.settings.samples} samples, ${episode.done} pushes`,
  });
  const group = (label, list) => (list.length ? el("optgroup", { label }, ...list.map(option)) : null);
  byId("beside-select").replaceChildren(...[
    el("option", { value: "", textContent: others.length ? "choose one" : "there is no other yet" }),
    group("To the same goal", others.filter(isRival)),
    group("To other goals", others.filter((episode) => !isRival(episode))),
  ].filter(Boolean));
  byId("beside-select").value = other?.id ?? "";
}

async function choose(id) {
  other = id ? await get(path(id)) : null;
  note({ beside: other?.id ?? null });
  draw();
}

function rows() {
  const both = [mine, other];
  const came = both.map(parts);
  const result = ["Distance", "Pushes", "Time"].map((label, i) => [label, came.map((one) => one[i])]);
  result.push(["Ended", both.map(({ outcome, status }) => outcome ?? status)]);
  for (const [key, label] of Object.entries(SETTINGS)) {
    const values = both.map(({ settings }) => settings[key]);
    if (values[0] !== values[1]) result.push([label, values.map(told)]);
  }
  return result;
}

function draw() {
  byId("beside").hidden = !mine || !other;
  if (!mine || !other) return;
  byId("beside-rows").replaceChildren(...rows().map(([label, values]) =>
    el("tr", {}, el("th", { textContent: label, scope: "row" }), ...values.map((value) => el("td", { textContent: value })))));
  byId("beside-name").textContent = other.name;
  const actions = mine.steps[at]?.step ?? 0;
  for (const [id, episode] of [["beside-mine", mine], ["beside-other", other]]) {
    const url = `api/${path(episode.id)}/frames/${roundAt(episode.steps, actions)}.png?part=now`;
    if (byId(id).getAttribute("src") !== url) byId(id).src = url;
  }
  const lines = [["this run", mine], [other.name, other]].map(([label, { steps }], i) => ({
    label, colour: COLOURS[i], values: steps.filter(offsets).map((step) => [step.step, farthest(step)]),
  }));
  drawLines(byId("beside-chart"), lines, { unit: "mm", at: actions, name: "Farthest object from its goal", none: NOT_KNOWN });
  drawLegend(byId("beside-key"), lines);
}

/** Follows the episode and the step that are on view; null when none is. */
export function drawBeside(episode, step) {
  const before = mine;
  const isOther = episode?.id !== before?.id;
  [mine, at] = [episode, step];
  byId("beside-card").hidden = !mine || LIVE.has(mine.status) || !mine.steps.length;
  if (isOther) {
    const id = before ? null : asked().beside; // what the address says is about the run that it names
    other = null;
    if (before) note({ beside: null });
    if (mine && id && id !== mine.id) {
      byId("beside-card").open = true;
      tellFailure(() => choose(id));
    }
    if (byId("beside-card").open) tellFailure(offer);
  }
  draw();
}

/** The table as it was before, the goal and the settings of the run on view; Start does the rest. */
async function runAgain() {
  if (!mayDrive()) return;
  if (mine.scene !== current()?.id) set("scene", await post(`scenes/${encodeURIComponent(mine.scene)}/activate`));
  const goal = known("goals").find(({ id }) => id === mine.goal);
  if (!goal) toast("The goal of this run has been deleted; choose another one.", "warning");
  else set("goal", goal);
  await resetScene();
  takeSettings(mine.settings);
  byId("settings-card").open = true;
  scrollTo(byId("settings-card"));
}

export function setUpBeside() {
  byId("beside-card").addEventListener("toggle", () => { if (byId("beside-card").open) tellFailure(offer); });
  byId("beside-select").addEventListener("change", ({ target }) => tellFailure(() => choose(target.value)));
  byId("run-again").addEventListener("click", () => act(byId("run-again"), runAgain));
}
