// The 3D view in its frame: the live table, or an episode in its place, as far as this page alone is concerned.
import { VISITOR, get, post, put } from "./api.js";
import { byId } from "./dom.js";
import { LIVE } from "./jobs.js";
import { Newest } from "./newest.js";
import { current, known, labelOf, set, watch } from "./state.js";
import { tellFailure } from "./toasts.js";

const FRAMES_PER_S = { rest: 12, start: 0.3, run: 2 }; // of a view that no graphics card draws: before the first push, and then

let replayed = null; // what is replayed, as the service was told last
let shows = "meshes";
let handles = false;

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

/** What is golden: the goal that was chosen, until an episode has found its own. */
const golden = () => (drawsHere(known("episode")) && known("episode").done > 0 ? null : known("goal")?.id ?? null);

async function show() {
  const goal = golden();
  try {
    return await put(`views/${VISITOR}`, { replay: replayed, shows, goal, handles });
  } catch (error) {
    if (error.status !== 404 || !goal || replayed) throw error;
    return null; // the goal was deleted, of which the page will be told
  }
}

const wish = new Newest(show);

/** Whether the service has a view of this page to draw in. */
export const isViewOpen = async () => isViewerShown() && (await tellFailure(show))?.is_open;

/** Shows a moment of a recording: {episode or story, at_s, plays, speed}; null for the live table. */
export function replay(what) {
  replayed = what;
  set("recorded", Boolean(what));
  tellNothing();
  wish.ask();
}

export const showLive = () => replay(null);

// Names of what the pointer rests on

const REST_MS = 120;
const NAMES = { pusher: "Pusher: drag it at an object", lamp: "Lamp: drag it" };

/** Names things in the view's window while the pointer rests on them; a finger that taps does so, too. */
function nameOnHover(view) {
  const tip = byId("pointed");
  let timer = 0;
  const name = async ({ clientX: x, clientY: y }) => {
    const rest = timer;
    const { innerWidth: width, innerHeight: height } = view;
    const query = new URLSearchParams({ x: x / width, y: y / height });
    const pointed = (await get(`views/${VISITOR}/pointed?${query}`).catch(() => null))?.name;
    if (!pointed || timer !== rest) return; // has moved on
    tip.textContent = NAMES[pointed] ?? labelOf(pointed);
    tip.hidden = false;
    tip.style.left = `${Math.min(Math.max(x, tip.offsetWidth / 2), width - tip.offsetWidth / 2)}px`;
    tip.style.top = `${Math.max(y - tip.offsetHeight - 14, 0)}px`;
  };
  const leave = () => {
    clearTimeout(timer);
    timer = 0;
    tip.hidden = true;
  };
  view.addEventListener("pointermove", (event) => {
    leave();
    if (!event.buttons) timer = setTimeout(name, REST_MS, event);
  }, { passive: true });
  for (const kind of ["pointerdown", "pointerout", "wheel"]) view.addEventListener(kind, leave, { passive: true });
}

/** A processor that also draws the view has more time for the search while there is one. */
function pace(job) {
  const phase = !LIVE.has(job?.state) ? "rest" : job.done ? "run" : "start";
  byId("viewer").contentWindow.framesPerSecond = FRAMES_PER_S[phase];
}

/** An episode is about to begin. */
export const paceForStart = () => pace({ state: "queued", done: 0 });
export const paceAgain = () => pace(known("episode"));

export function setUpViewer() {
  watch("episode", pace);
  byId("viewer").addEventListener("load", () => {
    paceAgain();
    if (replayed || shows !== "meshes" || handles || golden()) wish.ask(); // a service that was started again does not know
    nameOnHover(byId("viewer").contentWindow);
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
  byId("show-handles").addEventListener("click", () => {
    handles = !handles;
    byId("show-handles").setAttribute("aria-pressed", handles);
    wish.ask();
  });
  for (const radio of document.getElementsByName("shows")) {
    radio.addEventListener("change", () => {
      shows = radio.value;
      tellNothing();
      wish.ask();
    });
  }
}
