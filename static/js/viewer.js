// The 3D view in its frame: the live table, or an episode in its place, as far as this page alone is concerned.
import { VISITOR, post, put } from "./api.js";
import { byId } from "./dom.js";
import { isDriving } from "./driver.js";
import { LIVE } from "./jobs.js";
import { Newest } from "./newest.js";
import { current, known, watch } from "./state.js";
import { tellFailure } from "./toasts.js";

const FRAMES_PER_S = { rest: 12, start: 0.3, run: 2 }; // of a view that no graphics card draws: before the first push, and then

let replayed = null; // what is replayed, as the service was told last
let shows = "meshes";
let onLive = () => {};

/** Whether an episode or estimate has been drawn on the table that is shown. */
const drawsHere = (job) => Boolean(job) && job.state !== "queued" && job.params.scene === current()?.id;

function tellNothing() {
  const isEmpty = shows === "beliefs" && !replayed && !["episode", "estimate"].some((what) => drawsHere(known(what)));
  byId("nothing-believed").hidden = !isEmpty;
}

/** Loads the frame, again after the service was lost; what this page replays there is shown again by itself. */
export function showViewer() {
  byId("viewer").src = `viewer/${VISITOR}/?hideViserLogo&darkMode`;
  byId("viewer").hidden = byId("shows").hidden = false;
  byId("viewer-wait").hidden = true;
}

export const isViewerShown = () => !byId("viewer").hidden;

/** Whether the table that is pushed is the one on view. */
export const isLiveShown = () => !replayed;

/** What is golden: the goal that was chosen, until an episode has found its own. */
const golden = () => (drawsHere(known("episode")) && known("episode").done > 0 ? null : known("goal")?.id ?? null);
const show = () => put(`views/${VISITOR}`, { replay: replayed, shows, goal: golden() });
const wish = new Newest(show);

function ask(what) {
  replayed = what;
  tellNothing();
  wish.ask();
}

function draw(told) {
  byId("replaying").hidden = !told;
  byId("replaying-text").textContent = told;
}

/** Shows a moment of an episode: {episode, at_s, plays, speed}. `told` says what it is. */
export function replay(what, told) {
  draw(told);
  ask(what);
}

/** Likewise for a story, without a word over it; resolves to whether the view is open already. */
export async function replayStory(what) {
  draw("");
  replayed = what;
  tellNothing();
  const answer = await tellFailure(show);
  return answer?.is_open;
}

/** Back to the live table. */
export function showLive() {
  draw("");
  ask(null);
}

/** A processor that also draws the view has more time for the search while there is one. */
function pace(job) {
  const phase = !LIVE.has(job?.state) ? "rest" : job.done ? "run" : "start";
  byId("viewer").contentWindow.framesPerSecond = FRAMES_PER_S[phase];
}

/** An episode is about to begin. */
export const paceForStart = () => pace({ state: "queued", done: 0 });
export const paceAgain = () => pace(known("episode"));

/** `listener` is told when somebody wants the live table back. */
export function setUpViewer(listener) {
  onLive = listener;
  watch("episode", pace);
  byId("viewer").addEventListener("load", () => {
    paceAgain();
    if (replayed || shows !== "meshes" || golden()) wish.ask(); // a service that was started again does not know
  });
  for (const what of ["episode", "estimate", "scene"]) watch(what, tellNothing);
  let drawn = golden();
  for (const what of ["goal", "episode", "scene"]) {
    watch(what, () => {
      if (drawn === golden()) return;
      drawn = golden();
      wish.ask();
    });
  }
  byId("frame-view").addEventListener("click", () => tellFailure(() => post(`views/${VISITOR}/camera`)));
  for (const radio of document.getElementsByName("shows")) {
    radio.addEventListener("change", () => {
      shows = radio.value;
      tellNothing();
      wish.ask();
    });
  }
  const backToLive = () => {
    onLive(); // first: what plays is stopped, and shown where it stopped
    showLive();
  };
  byId("back-to-live").addEventListener("click", backToLive);
  let table;
  watch("scene", (scene) => {
    const isOther = table !== undefined && scene && scene.id !== table;
    table = scene === undefined ? undefined : scene?.id ?? null;
    if (isOther && isDriving() && !byId("replaying").hidden) backToLive(); // whoever chooses a table wants to see it
  });
}
