// Starting an episode, and the controls of the one that runs.
import { post, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { isDriving, mayDrive } from "./driver.js";
import { chosenSettings, lend } from "./episode-settings.js";
import { LIVE, stateText, timeLeft } from "./jobs.js";
import { resetScene } from "./scenes.js";
import { current, inWords, known, set, watch } from "./state.js";
import { act, tellFailure, toast } from "./toasts.js";

const STAGES = {
  first: "Looking at the table", goal: "Looking at the goal image", plan: "Planning pushes", act: "Pushing",
  next: "Looking again", search: "Searching for what was lost",
};
const PAUSED = "Paused; objects and lamp may be moved by hand";
const LOOP = [["Look", ["first", "next", "search"]], ["Goal", ["goal"]], ["Plan", ["plan"]], ["Act", ["act"]]];
const OVER_MS = 10_000; // a cancel takes about a second
const LOOK_MS = 100;
let before = { id: "", state: "" };
let isStarting = false; // until the service has answered

const live = () => (LIVE.has(known("episode")?.state) ? known("episode") : null);
const path = (what = "") => `episodes/${live().id}${what}`;

// Starting

const isPublished = () => chosenSettings()?.method === "paper";

/** Why an episode cannot start now; "" if it can. */
function reason(changes = {}) {
  const scene = current();
  if (!isDriving()) return "Someone else is driving; take over to start.";
  if (isStarting) return "One moment.";
  if (scene === undefined) return "The simulation is starting.";
  if (!scene) return "Choose a table first.";
  if (known("draft")) return "Save the goal that is being composed, or stop composing.";
  if (!known("goal")) return "Choose a goal first.";
  const fields = known("fields");
  const missing = fields ? scene.objects.filter(({ name }) => !fields.some((field) => field.name === name)) : [];
  if (missing.length) return `No field has been learned of ${missing.map(({ label }) => label).join(", ")}; train one in Your objects.`;
  if (!chosenSettings()) return "A setting cannot be used; see Settings.";
  const unpublished = fields && isPublished() ? scene.objects.filter(({ name }) => !fields.find((field) => field.name === name).published) : [];
  if (unpublished.length) return `There is no field as published of ${unpublished.map(({ label }) => label).join(", ")}; choose our method in Settings, or train one in Your objects.`;
  if (known("check")?.refused && !{ ...chosenSettings(), ...changes }.despite_doubts) return known("check").text;
  return "";
}

/** Starts an episode as the page's settings say, or with some of them changed. */
export function startEpisode(changes = {}) {
  if (live() || isStarting || byId("run-idle").hidden) return undefined;
  const why = reason(changes);
  if (why) return toast(why, "warning");
  const body = { scene: current().id, goal: known("goal").id, seed: 0, settings: lend(changes) };
  isStarting = true;
  drawStart();
  return tellFailure(async () => set("opened", { id: (await post("episodes", body)).id }), byId("start-reason")).finally(() => {
    isStarting = false;
    drawStart();
  });
}

function drawStart() {
  const why = reason();
  byId("start-episode").disabled = why !== "";
  byId("start-reason").textContent = why || `It looks, plans and pushes ${isPublished() ? "as often as Settings say" : "until the table looks like the goal"}.`;
}

// Controls

const does = (button, action) => act(button, action).then(() => drawLive(live()));

export function togglePause() {
  if (!live() || live().state === "queued" || !mayDrive()) return;
  does(byId("run-pause"), () => post(path(live().state === "paused" ? "/resume" : "/pause")));
}

export function stepOnce() {
  if (live()?.state !== "paused" || !mayDrive()) return;
  does(byId("run-step"), () => post(path("/step")));
}

export function cancelEpisode() {
  if (!live() || !mayDrive()) return;
  does(byId("run-cancel"), () => remove(path()));
}

/** Puts everything back; an episode that runs is stopped before, since it holds the table. */
export async function resetTable() {
  if (!live()) return resetScene();
  if (!mayDrive()) return undefined;
  return does(byId("run-reset"), async () => {
    await remove(path());
    for (let waited = 0; live() && waited < OVER_MS; waited += LOOK_MS) await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
    await resetScene();
  });
}

function stageText(job) {
  if (job.state === "queued") return stateText(job).replace(/^./, (letter) => letter.toUpperCase());
  if (job.state === "paused") return PAUSED;
  return inWords(job.note) || STAGES[job.result?.stage] || "Getting ready";
}

function drawLive(job) {
  byId("run-idle").hidden = Boolean(job);
  byId("run-live").hidden = !job;
  if (!job) return;
  const isPaused = job.state === "paused";
  byId("run-stage").textContent = stageText(job);
  byId("run-count").textContent = job.total ? `step ${job.done} of ${job.total}` : "";
  for (const [i, [, stages]] of LOOP.entries()) {
    const isNow = job.state === "running" && stages.includes(job.result?.stage);
    const item = byId("run-loop").children[i];
    if (isNow) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  }
  byId("run-bar").value = job.result?.share ?? 0;
  byId("run-stage").title = byId("run-stage").textContent;
  byId("run-left").textContent = job.state === "running" ? timeLeft(job.result?.left_s ?? null).replace(/^, /, "") : "";
  byId("run-told").textContent = isPaused ? PAUSED : "";
  byId("run-pause").textContent = isPaused ? "Resume" : "Pause";
  byId("run-pause").disabled = job.state === "queued";
  byId("run-step").hidden = !isPaused;
}

function tellEnd(job) {
  if (job.state === "failed") toast(job.error, "error");
  else if (job.state === "interrupted") toast("The service was stopped during the episode; its steps are kept.", "warning");
}

function draw() {
  const job = known("episode");
  const wasLive = LIVE.has(before.state);
  drawLive(live());
  drawStart();
  if (live() && (before.id !== job.id || !wasLive)) {
    for (const card of ["table-card", "goal-card"]) byId(card).open = false; // room for what comes
  }
  if (job && before.id === job.id && wasLive && !live()) tellEnd(job);
  before = { id: job?.id ?? "", state: job?.state ?? "" };
}

export function setUpEpisode() {
  byId("run-loop").append(...LOOP.map(([name]) => el("li", { textContent: name })));
  byId("start-episode").addEventListener("click", () => startEpisode());
  byId("run-pause").addEventListener("click", togglePause);
  byId("run-step").addEventListener("click", stepOnce);
  byId("run-cancel").addEventListener("click", cancelEpisode);
  byId("run-reset").addEventListener("click", resetTable);
  for (const what of ["scene", "objects", "fields", "goal", "check", "draft", "driver", "settings"]) watch(what, drawStart);
  watch("episode", draw);
}
