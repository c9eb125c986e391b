// What this is, shown before anybody clicks: a recorded episode in the 3D view, its goal, its table, and how far it is.
import { asked } from "./address.js";
import { get, post } from "./api.js";
import { drawLegend } from "./charts.js";
import { COLOURS, svg } from "./curves.js";
import { byId } from "./dom.js";
import { startEpisode } from "./episode.js";
import { closeShown } from "./episode-view.js";
import { takeGoal } from "./goals.js";
import { LIVE } from "./jobs.js";
import { refreshObjects } from "./objects.js";
import { length } from "./run-summary.js";
import { refreshScenes } from "./scenes.js";
import { known, labelOf, objects, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { act, tellFailure, toast } from "./toasts.js";
import { isViewerShown, paceAgain, paceForStart, replayStory, showLive } from "./viewer.js";

const TICK_MS = 80;
const LENGTH_S = 11; // of a story; its replay is played as much faster as that takes
const REST_S = 4; // at its end
const ROUNDS = 2; // of all stories, then the last one rests: an open page at rest costs nothing
const WAIT_MS = 300;
const PATIENCE_MS = 30_000; // with a 3D view that does not open; then pictures and curve play alone
const SEEN = "osf-story-seen";
const [WIDTH, HEIGHT] = [300, 64];

const isLinked = Boolean(asked().episode);

let stories = [];
let number = 0; // of the one that plays, counted through all rounds
let timer = 0;
let since = 0;
let isOn = false;

const story = () => stories[number % stories.length];
const speed = () => Math.max(story().step_s.at(-1) / LENGTH_S, 1);
const farthest = (left) => Math.max(...Object.values(left));

// Drawing

function stageAt(at, step) {
  const { goal_look_s: goalLook, step_s: times, left_mm: left, pushes, took_s: took, light_off_deg: off } = story();
  if (at < goalLook) return "Four cameras look: which pose of each object, and which lamp, explain what they see?";
  if (at < times[0]) return `Lamp found to ${off.toFixed(1)}°. Now the photo: where should everything be?`;
  if (step < times.length - 1) return `Push ${step + 1} of ${pushes}: purple is the plan, golden is the goal, wires are what it believes`;
  return `${length(farthest(left[0]))} to ${length(farthest(left.at(-1)))} in ${pushes} pushes; it took ${took.toFixed(0)} s on two CPU cores`;
}

function drawCurve(at) {
  const { objects, step_s: times, left_mm: left } = story();
  const end = times.at(-1);
  const most = Math.max(...left.map(farthest), 1);
  const shown = times.filter((time) => time <= at).length;
  const lines = objects.map((name, i) => {
    const points = left.slice(0, Math.max(shown, 1)).map((mm, k) => `${((WIDTH * times[k]) / end).toFixed(1)},${(HEIGHT - (HEIGHT - 4) * (mm[name] / most)).toFixed(1)}`);
    const line = svg("path", { d: `M0,${points[0].split(",")[1]} L${points.join(" L")}` });
    line.style.stroke = COLOURS[i % COLOURS.length];
    return line;
  });
  byId("story-curve").replaceChildren(svg("path", { d: `M0,${HEIGHT} H${WIDTH}`, class: "axis" }), ...lines);
  const now = left[Math.max(shown - 1, 0)];
  drawLegend(byId("story-key"), objects.map((name, i) => ({ label: `${labelOf(name)} ${length(now[name])}`, colour: COLOURS[i % COLOURS.length] })));
}

function draw(at) {
  const { step_s: times, now_columns: columns } = story();
  const step = Math.max(times.filter((time) => time <= at).length - 1, 0);
  const [column, row] = [step % columns, Math.floor(step / columns)];
  byId("story-now").style.transform = `translate(${(-100 * column) / columns}%, ${(-100 * row) / Math.ceil(times.length / columns)}%)`;
  const stage = stageAt(at, step);
  if (byId("story-stage").textContent !== stage) byId("story-stage").textContent = stage; // it is read aloud
  drawCurve(at);
}

function begin() {
  const { goal_image: goal, now_image: now, now_columns: columns, objects } = story();
  byId("story-goal").src = goal;
  byId("story-now").src = now;
  byId("story-now").style.width = `${100 * columns}%`;
  byId("story-goal").alt = `The photo of how ${objects.map(labelOf).join(", ")} should lie`;
  byId("story-again").hidden = true;
  draw(0);
}

// Playing

async function play() {
  clearInterval(timer);
  begin();
  let isOpen = false;
  for (const until = performance.now() + PATIENCE_MS; isOn && !isOpen && performance.now() < until; ) {
    isOpen = isViewerShown() && (await replayStory({ story: story().name, at_s: 0, plays: false, speed: 1 }));
    if (!isOpen) await new Promise((resolve) => setTimeout(resolve, WAIT_MS));
  }
  if (!isOn) return;
  await replayStory({ story: story().name, at_s: 0, plays: true, speed: speed() });
  since = performance.now();
  clearInterval(timer);
  timer = setInterval(tick, TICK_MS);
}

function tick() {
  const at = (speed() * (performance.now() - since)) / 1000;
  const end = story().step_s.at(-1);
  draw(Math.min(at, end));
  if (at < end + REST_S * speed()) return;
  clearInterval(timer);
  if (number + 1 < ROUNDS * stories.length && !document.hidden) {
    number += 1;
    play();
  } else byId("story-again").hidden = false;
}

/** The story takes the place of the cameras, which show another table. */
function show(on) {
  byId("story").hidden = byId("story-foot").hidden = !on;
  byId("cameras").hidden = on;
}

function open() {
  if (!stories.length || isOn) return;
  closeShown(); // both would want the 3D view
  isOn = true;
  show(true);
  play();
}

/** Ends the story; the live table is on view again. */
export function closeStory() {
  if (!isOn) return;
  isOn = false;
  clearInterval(timer);
  show(false);
  sessionStorage.setItem(SEEN, "1");
  showLive();
}

// What to do next

const isHere = (name) => objects().some((object) => object.name === name && object.available);

async function layTable() {
  const { scene, goal } = await post(`presets/${encodeURIComponent(story().name)}`);
  set("scene", { ...scene, is_current: true });
  takeGoal(goal);
  refreshScenes();
}

async function runLive() {
  const missing = story().objects.filter((name) => !isHere(name));
  if (missing.length) {
    closeStory();
    showTab("objects");
    return toast(`${missing.map(labelOf).join(", ")} must be fetched first: press Fetch beside them.`, "warning");
  }
  paceForStart();
  try {
    await layTable();
    closeStory();
    await startEpisode();
  } finally {
    paceAgain();
  }
}

/** Shows where photos are worked on, while the page asks for one. */
function usePhoto() {
  closeStory();
  showTab("photo");
}

function moveLamp() {
  closeStory();
  showTab("drive");
  byId("azimuth").focus();
}

/** Whether somebody came for something else. */
const hasOtherPlans = () => LIVE.has(known("episode")?.state) || Boolean(known("opened")) || isLinked;

export async function setUpStory() {
  const run = byId("story-run");
  run.addEventListener("click", () => act(run, runLive));
  byId("story-photo").addEventListener("click", usePhoto);
  byId("story-lamp").addEventListener("click", moveLamp);
  byId("story-close").addEventListener("click", closeStory);
  byId("story-again").addEventListener("click", () => {
    number += 1;
    play();
  });
  byId("story-button").addEventListener("click", open);
  // Whoever chooses another table or an episode wants to see that.
  let table;
  watch("scene", (scene) => {
    if (scene && table && scene.id !== table) closeStory();
    table = scene?.id ?? table;
  });
  watch("opened", (opened) => { if (opened) closeStory(); });
  watch("report", (report) => { if (report) closeStory(); });
  watch("episode", (job) => {
    byId("story-button").disabled = LIVE.has(job?.state);
    if (hasOtherPlans()) closeStory();
  });
  const [answer] = await Promise.all([tellFailure(() => get("stories")), refreshObjects()]);
  // Those that can be run live come first.
  const answers = (answer?.stories ?? []).filter(({ outcome }) => outcome === "reached");
  const canRun = (one) => one.objects.every(isHere);
  stories = [...answers.filter(canRun), ...answers.filter((one) => !canRun(one))];
  byId("story-button").hidden = !stories.length;
  if (!hasOtherPlans() && !sessionStorage.getItem(SEEN)) open();
}
