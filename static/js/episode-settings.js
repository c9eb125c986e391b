// How an episode goes: chosen before it, and changed while it runs.
import { get, patch } from "./api.js";
import { byId, el } from "./dom.js";
import { LIVE } from "./jobs.js";
import { Newest } from "./newest.js";
import { known, set, watch } from "./state.js";
import { tellFailure } from "./toasts.js";

// The sliders span what makes sense; the numbers beside them take all that is allowed.
const SLIDERS = [
  { name: "horizon", label: "Horizon, actions", title: "How far the plans look ahead, in actions of 0.2 s", low: 5, high: 80 },
  { name: "samples", label: "Samples", title: "How many futures are predicted in each round", low: 16, high: 1024, isLog: true },
  { name: "temperature", label: "Temperature", title: "How much worse futures count: small keeps the best alone", low: 0.001, high: 1, isLog: true },
  { name: "steps", label: "Pushes at most", title: "Of 0.2 s each", low: 1, high: 100 },
  { name: "replan_every", label: "Replan after, actions", title: "Actions that are executed of each plan", low: 1, high: 10, isOurs: true },
];
const SWITCHES = ["planning", "acting", "despite_doubts"];
const COSTS = {
  pose: "Futures are compared with where the objects should be: fast.",
  image: "Futures are rendered and compared with the goal image, as in the paper: slower.",
};
const METHODS = {
  ours: "It finds where things should be in the goal image, and plans pushes toward that.",
  paper: "The method of the paper: it compares rendered futures with the goal image, anew for each push. It never knows how far things are from their goals.",
};
const FINE = 1000; // places of a slider

let lent = null; // what the form said before a run with other settings
let offered = null; // {defaults, bounds} once the service has told them
const form = () => byId("episode-settings");
const live = () => (LIVE.has(known("episode")?.state) ? known("episode") : null);
const running = () => (live() && known("report")?.id === live().id ? known("report") : null);
const changes = new Newest(async ({ id, settings }) => {
  const episode = await patch(`episodes/${id}/settings`, settings);
  set("report", episode);
});

const isWhole = (name) => name !== "temperature";
const share = ({ low, high, isLog }, value) => FINE * (isLog ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));

function valueAt({ name, low, high, isLog }, place) {
  const value = isLog ? low * (high / low) ** (place / FINE) : low + ((high - low) * place) / FINE;
  return isWhole(name) ? Math.round(value) : Number(value.toPrecision(2));
}

/** What the form says; null while something in it cannot be used. */
export function chosenSettings() {
  if (!offered || !form().checkValidity()) return null;
  const { elements } = form();
  return {
    method: elements.method.value,
    cost: elements.cost.value,
    ...Object.fromEntries(SLIDERS.map(({ name }) => [name, elements[name].valueAsNumber])),
    ...Object.fromEntries(SWITCHES.map((name) => [name, elements[name].checked])),
  };
}

function fill(settings) {
  const { elements } = form();
  for (const slider of SLIDERS) {
    elements[slider.name].value = settings[slider.name];
    byId(`slide-${slider.name}`).value = share(slider, settings[slider.name]);
  }
  for (const name of SWITCHES) elements[name].checked = settings[name];
  elements.cost.value = settings.cost;
  elements.method.value = settings.method;
  tell();
}

function tell() {
  const { method, cost, samples, steps } = form().elements;
  const isPaper = method.value === "paper";
  byId("method-hint").textContent = METHODS[method.value];
  byId("cost-hint").textContent = COSTS[cost.value];
  byId("settings-facts").textContent = `${isPaper ? "as published" : `${cost.value} cost`}, ${samples.value} samples, ${steps.value} pushes`;
  for (const node of form().querySelectorAll(".ours-only")) node.hidden = isPaper; // the other method has no such thing
  // An episode keeps its method, and the one as published all else, too.
  for (const element of form().elements) element.disabled = Boolean(live()) && (isPaper || element === method);
}

/** Another method begins with its own defaults. */
function changeMethod({ target }) {
  if (!offered || target !== form().elements.method) return;
  const { method, despite_doubts: doubts } = form().elements;
  fill({ ...(method.value === "paper" ? offered.published : offered.defaults), despite_doubts: doubts.checked });
}

/** A change by hand: at once, where an episode runs. */
function change() {
  if (!offered) return;
  tell();
  const settings = chosenSettings();
  if (!settings) form().reportValidity();
  else if (live()) changes.ask({ id: live().id, settings });
  set("settings", settings);
}

function row(slider) {
  const { name, label, title, isOurs } = slider;
  const number = el("input", { type: "number", name, id: `setting-${name}`, step: isWhole(name) ? 1 : "any", required: true });
  const range = el("input", { type: "range", id: `slide-${name}`, min: 0, max: FINE, step: 1, attributes: { "aria-label": `${label}, slider` } });
  range.addEventListener("input", () => { number.value = valueAt(slider, Number(range.value)); });
  number.addEventListener("input", () => { if (number.value > 0) range.value = share(slider, number.valueAsNumber); });
  const caption = el("label", { textContent: label, title });
  caption.htmlFor = number.id;
  const nodes = [caption, range, number];
  if (isOurs) for (const node of nodes) node.classList.add("ours-only");
  return nodes;
}

/** Takes over the settings of another run; one that runs keeps its own. */
export function takeSettings(settings) {
  if (!offered) return;
  fill(settings);
  set("settings", chosenSettings());
}

/** Another goal or table: what was overruled for the one before does not count for it. */
export function forgetDoubts() {
  form().elements.despite_doubts.checked = false;
  if (offered) set("settings", chosenSettings());
}

/** Settings for one run alone: the form says again afterwards what it says now. */
export function lend(changes) {
  if (Object.keys(changes).length) lent = chosenSettings();
  return { ...chosenSettings(), ...changes };
}

function takeBack() {
  if (!lent || live()) return;
  const settings = lent;
  lent = null;
  takeSettings(settings);
}

/** Within what an object has arrived: { mm, deg }; null before the service has told it. */
export const reached = () => (offered ? { mm: offered.reached_mm, deg: offered.reached_deg } : null);

export async function refreshSettings() {
  const answer = await tellFailure(() => get("settings"));
  if (!answer) return;
  const isFirst = offered === null;
  offered = answer.episode;
  for (const [name, [low, high]] of Object.entries(offered.bounds)) Object.assign(form().elements[name] ?? {}, { min: low, max: high });
  if (isFirst) fill(running()?.settings ?? offered.defaults);
  set("settings", chosenSettings());
}

export function setUpEpisodeSettings() {
  byId("settings-sliders").append(...SLIDERS.flatMap(row));
  form().addEventListener("submit", (event) => event.preventDefault());
  form().addEventListener("input", tell);
  form().addEventListener("change", changeMethod);
  form().addEventListener("change", change);
  byId("despite-doubts").addEventListener("change", change); // it stands where doubts are told, outside the form
  byId("settings-defaults").addEventListener("click", () => {
    if (!offered) return;
    fill(offered.defaults);
    change();
  });
  // Another visitor may have chosen or changed them; what the hand does here now counts more.
  let before;
  watch("episode", (job) => {
    if (LIVE.has(before) && !LIVE.has(job?.state)) takeBack();
    before = job?.state;
    tell();
  });
  watch("report", () => {
    if (offered && running() && !changes.isBusy && !form().contains(document.activeElement)) fill(running().settings);
  });
  refreshSettings();
}
