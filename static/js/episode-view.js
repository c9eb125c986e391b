// One episode on view, running or over: its pictures and numbers at a step, its charts, and what was noticed.
import { asked, note, onTravel } from "./address.js";
import { get } from "./api.js";
import { drawBeside } from "./beside.js";
import { byId, el } from "./dom.js";
import { LIVE } from "./jobs.js";
import { drawEnding } from "./ending.js";
import { preload, setUpPictures, showFrame, standIn } from "./pictures.js";
import { drawProgress, setUpProgress } from "./progress-charts.js";
import { drawResults } from "./results.js";
import { NOT_KNOWN, offsets, roundAt } from "./run-summary.js";
import { current, inWords, known, labelOf, set, watch } from "./state.js";
import { scrollTo } from "./tabs.js";
import { timeline } from "./timeline.js";
import { tellFailure, toast } from "./toasts.js";

let shown = null; // the episode, as fetched last
let wanted = null; // {id, step} to be fetched next, a step by its actions; none: stay where one is
let isFetching = false;
let closings = 0;
let followed = ""; // the job that was put on view by itself
let seen = ""; // how far the job was when it was fetched for
let noting = 0;

const NOTE_MS = 300;
const STEP_S = 0.6; // for episodes of earlier versions, which do not tell when a step is over
const PREPARED = "What it found in table and photo was prepared with this example; from the first push on, all is live.";
const PUBLISHED = "This is the method as published.";
const OUTCOMES = { reached: "Reached", "out of steps": "Out of steps", refused: "Refused" };
const frameUrl = (round) => `api/episodes/${encodeURIComponent(shown.id)}/frames/${round}.png?part=all`;
const one = (value) => (Number.isFinite(value) ? value.toFixed(1) : "");

/** How alike goal image and rendered estimate are. */
function likeness({ image_cost: cost, ssim }) {
  const psnr = `${(-10 * Math.log10(Math.max(cost, 1e-10))).toFixed(1)} dB`;
  return Number.isFinite(ssim) ? `${psnr} · SSIM ${ssim.toFixed(2)}` : `PSNR ${psnr}`;
}

/** How an episode ended, or that it has not. */
export function outcomeOf(episode) {
  const text = OUTCOMES[episode.outcome] ?? episode.status.replace(/^./, (letter) => letter.toUpperCase());
  const isBad = episode.status === "failed" || episode.outcome === "refused";
  const isGood = episode.status === "running" || episode.outcome === "reached";
  return { text, state: isGood ? "live" : isBad ? "lost" : "wait" };
}

/** Fetches what the latest event or click was about, one request at a time. */
async function fetchWanted() {
  if (isFetching) return;
  isFetching = true;
  while (wanted) {
    const { id, step } = wanted;
    wanted = null;
    const before = closings;
    const found = await tellFailure(() => get(`episodes/${encodeURIComponent(id)}`));
    if (found && before === closings) showEpisode(found, step); // unless it was closed meanwhile
  }
  isFetching = false;
}

export function openEpisode(id, step) {
  wanted = { id, step };
  return fetchWanted();
}

/** Puts a fetched episode on view, after so many actions or where one is. */
export function showEpisode(episode, step) {
  const isOther = shown?.id !== episode.id;
  shown = episode;
  set("report", episode);
  byId("shown").hidden = false;
  byId("shown").dataset.episode = episode.id;
  byId("shown").classList.toggle("before-steps", LIVE.has(episode.status) && !episode.steps.length);
  if (isOther) {
    note({ episode: episode.id, step: step ?? null });
    drawStandIn();
  }
  drawHead(episode);
  const most = episode.steps.at(-1)?.step;
  if (Number.isFinite(step) && step > most) toast(`This episode has steps 0 to ${most}; showing the last one.`, "warning");
  const source = sourceOf(episode);
  timeline.show(source, Number.isFinite(step) ? source.times[roundAt(episode.steps, step)] : undefined);
  drawEnding(episode);
  drawResults(episode);
  if (!isOther) return;
  if (LIVE.has(episode.status)) scrollTo(byId("shown"));
  else byId("shown").scrollIntoView({ block: "start" }); // somebody asked for it
}

/** What the timeline needs to know of an episode. */
function sourceOf({ id, name, status, steps, step_s: times }) {
  return {
    of: { episode: id }, name, isRunning: LIVE.has(status),
    times: times.length < steps.length ? steps.map((_, i) => STEP_S * i) : times,
    actions: steps.map(({ step }) => step),
    draw: drawStep,
    left: hideShown,
  };
}

/** What there is before the first step: the goal, and what the goal camera sees if the episode's table is on view. */
function drawStandIn() {
  const { goal, scene: id, status, steps } = shown;
  const scene = current();
  const query = new URLSearchParams({ size: 192, pusher: true, v: scene?.revision });
  standIn({
    goal: goal && !steps.length ? `api/goals/${encodeURIComponent(goal)}/image.png` : null,
    now: scene?.id === id && LIVE.has(status) && !steps.length ? `api/scenes/${id}/images/goal.png?${query}` : null,
  });
}

function drawHead(episode) {
  const { text, state } = outcomeOf(episode);
  byId("shown-title").textContent = episode.name;
  byId("shown-title").title = episode.objects.map(labelOf).join(", ");
  byId("shown-outcome").textContent = text;
  byId("shown-outcome").dataset.state = state;
  const isPrepared = episode.notices.some(({ matter }) => matter === "prepared");
  const told = [episode.settings.method === "paper" && PUBLISHED, inWords(episode.text ?? "") || (isPrepared && PREPARED)];
  byId("shown-text").textContent = told.filter(Boolean).join(" ");
  byId("shown-text").hidden = !byId("shown-text").textContent;
  byId("shown-error").textContent = inWords(episode.error ?? "");
  byId("shown-error").hidden = !episode.error;
  byId("close-shown").hidden = LIVE.has(episode.status);
  byId("noticed").hidden = episode.notices.length === 0;
  byId("notice-list").replaceChildren(...episode.notices.map((notice) => el(
    "li", {},
    el("button", { type: "button", className: "plain", textContent: `Step ${notice.step}`, on: { click: () => goTo(notice.step) } }),
    el("span", { textContent: inWords(notice.text) }),
  )));
}

/** To the round that was over after so many actions. */
const goTo = (actions) => timeline.go(timeline.times[roundAt(shown.steps, actions)]);

/** Once the slider rests: browsers refuse an address that changes with each pixel. */
function noteStep() {
  clearTimeout(noting);
  const { id } = shown;
  noting = setTimeout(() => {
    if (shown?.id === id) note({ step: timeline.index < shown.steps.length - 1 ? shownStep() : null });
  }, NOTE_MS);
}

function drawStep(at) {
  if (!shown) return;
  const step = shown.steps[at];
  byId("shown-likeness").textContent = step ? likeness(step) : "";
  byId("shown-likeness").title = step ? `PSNR and SSIM of goal image and rendered estimate; image cost ${step.image_cost.toPrecision(3)}` : "";
  const knowsTruth = shown.steps.some((other) => other.estimate_off_mm);
  byId("estimate-off-head").hidden = !knowsTruth;
  const far = step && offsets(step);
  byId("to-go-head").title = step?.truly_to_goal_mm ? "True distance to where it should be, which only the simulation knows"
    : `Distance to where it should be, ${step && !far ? NOT_KNOWN : "as estimated"}`;
  byId("offset-rows").replaceChildren(...shown.objects.map((name) => {
    const cells = [far, step?.to_goal_deg, ...(knowsTruth ? [step?.estimate_off_mm] : [])];
    const row = el("tr", {}, el("td", { textContent: labelOf(name) }), ...cells.map((of) => el("td", { textContent: of ? one(of[name]) : step ? "–" : "" })));
    row.dataset.object = name;
    return row;
  }));
  drawProgress(shown, step ? step.step : -1);
  drawBeside(shown, at);
  if (!step) return;
  showFrame(frameUrl(at));
  if (!timeline.isPlaying) noteStep();
  else if (at + 1 < shown.steps.length) preload(frameUrl(at + 1));
}

// Whether somebody came to see a certain episode; then one that runs already does not push in front of it.
const isLinked = Boolean(asked().episode);

/** A new episode comes on view by itself; one that is on view is fetched again when it got further. */
function follow(job) {
  if (!job) return;
  if (LIVE.has(job.state) && followed !== job.id) {
    if (followed || !isLinked) wanted = { id: job.id };
    followed = job.id;
  }
  const far = `${job.id} ${job.state} ${job.result?.stage} ${job.result?.steps}`;
  if (far !== seen && shown?.id === job.id && !wanted) wanted = { id: job.id };
  seen = far;
  if (wanted) fetchWanted();
}

function hideShown() {
  shown = null;
  wanted = null;
  closings += 1;
  note({ episode: null, step: null, beside: null });
  drawBeside(null, 0);
  byId("shown").hidden = true;
}

/** Takes the episode on view off it; one that runs comes back on view. */
export function closeShown() {
  if (!shown) return;
  hideShown();
  timeline.close();
  showRunning();
}

/** Puts an episode that runs on view, unless one is. */
export function showRunning() {
  const job = known("episode");
  if (!shown && LIVE.has(job?.state)) openEpisode(job.id);
}

/** Takes an episode off view that was removed for good. */
export function dropShown(id) {
  if (shown?.id === id) closeShown();
}

/** The step that is on view, by its actions, for links. */
export const shownStep = () => shown?.steps[timeline.index]?.step ?? 0;

/** After the service was lost: what is on view may have gone on. */
export function refreshShown() {
  if (shown) openEpisode(shown.id);
}

/** Back or forward: the episode and step of the address, or none. */
function travel({ episode, step }) {
  const at = step === undefined ? undefined : Number(step);
  if (!episode && shown && !LIVE.has(shown.status)) closeShown();
  else if (episode && shown?.id !== episode) openEpisode(episode, at);
  else if (episode && Number.isInteger(at)) goTo(at);
}

export function setUpEpisodeView() {
  onTravel(travel);
  setUpPictures();
  setUpProgress(() => shown?.steps.at(-1)?.step ?? 0, goTo);
  byId("close-shown").addEventListener("click", closeShown);
  watch("objects", () => {
    if (!shown) return;
    drawHead(shown);
    drawStep(timeline.index);
  });
  watch("episode", follow);
  watch("opened", (opened) => { if (opened) openEpisode(opened.id, opened.step); });
  watch("scene", () => {
    if (shown && !shown.steps.length) drawStandIn();
  });
}
