// What this is, shown before anybody clicks: a recorded episode on the timeline, its goal, its table, and how far it is.
import { get, post } from "./api.js";
import { drawLegend } from "./charts.js";
import { COLOURS, svg } from "./curves.js";
import { byId } from "./dom.js";
import { startEpisode } from "./episode.js";
import { showRunning } from "./episode-view.js";
import { takeGoal } from "./goals.js";
import { LIVE } from "./jobs.js";
import { refreshObjects } from "./objects.js";
import { length } from "./run-summary.js";
import { refreshScenes } from "./scenes.js";
import { known, labelOf, objects, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { timeline } from "./timeline.js";
import { act, tellFailure, toast } from "./toasts.js";
import { isViewOpen, paceAgain, paceForStart } from "./viewer.js";

const SPEED = 2; // at which a story takes about ten seconds
const REST_MS = 4000; // at its end
const BEFORE = 2; // steps of the timeline before the first one of the episode: looking at the table, and at the goal
const ROUNDS = 2; // of all stories, then the last one rests: an open page at rest costs nothing
const WAIT_MS = 300;
const PATIENCE_MS = 30_000; // with a 3D view that does not open; then pictures and curve play alone
const SEEN = "osf-story-seen";
const [WIDTH, HEIGHT] = [300, 64];

const isStill = matchMedia("(prefers-reduced-motion: reduce)"); // then it stands until somebody plays it

let stories = [];
let number = 0; // of the one that plays, counted through all rounds
let resting = 0;
let isOn = false;

const story = () => stories[number % stories.length];
const farthest = (left) => Math.max(...Object.values(left));

// Drawing

function stageAt(index) {
  const { left_mm: left, pushes, took_s: took, light_off_deg: off } = story();
  if (index === 0) return "Four cameras look: which pose of each object, and which lamp, explain what they see?";
  if (index < BEFORE) return `Lamp found to ${off.toFixed(1)}°. Now the photo: where should everything be?`;
  if (index - BEFORE < pushes) return `Push ${index - BEFORE + 1} of ${pushes}: purple is the plan, golden is the goal, wires are what it believes`;
  return `${length(farthest(left[0]))} to ${length(farthest(left.at(-1)))} in ${pushes} pushes; it took ${took.toFixed(0)} s on two CPU cores`;
}

function drawCurve(step) {
  const { objects, step_s: times, left_mm: left } = story();
  const end = times.at(-1);
  const most = Math.max(...left.map(farthest), 1);
  const lines = objects.map((name, i) => {
    const points = left.slice(0, step + 1).map((mm, k) => `${((WIDTH * times[k]) / end).toFixed(1)},${(HEIGHT - (HEIGHT - 4) * (mm[name] / most)).toFixed(1)}`);
    const line = svg("path", { d: `M0,${points[0].split(",")[1]} L${points.join(" L")}` });
    line.style.stroke = COLOURS[i % COLOURS.length];
    return line;
  });
  byId("story-curve").replaceChildren(svg("path", { d: `M0,${HEIGHT} H${WIDTH}`, class: "axis" }), ...lines);
  const now = left[step];
  drawLegend(byId("story-key"), objects.map((name, i) => ({ label: `${labelOf(name)} ${length(now[name])}`, colour: COLOURS[i % COLOURS.length] })));
}

function draw(index) {
  clearTimeout(resting);
  const { step_s: times, now_columns: columns } = story();
  const step = Math.max(index - BEFORE, 0);
  const [column, row] = [step % columns, Math.floor(step / columns)];
  byId("story-now").style.transform = `translate(${(-100 * column) / columns}%, ${(-100 * row) / Math.ceil(times.length / columns)}%)`;
  const stage = stageAt(index);
  if (byId("story-stage").textContent !== stage) byId("story-stage").textContent = stage; // it is read aloud
  drawCurve(step);
}

// Playing

async function play() {
  const { name, title, goal_look_s: goalLook, step_s: times, goal_image: goal, now_image: now, now_columns: columns, objects } = story();
  byId("story-goal").src = goal;
  byId("story-now").src = now;
  byId("story-now").style.width = `${100 * columns}%`;
  byId("story-goal").alt = `The photo of how ${objects.map(labelOf).join(", ")} should lie`;
  const source = {
    of: { story: name }, name: title, isRunning: false, speed: SPEED,
    times: [0, goalLook, ...times], actions: [0, 0, ...times.keys()],
    draw, ended, left: closeStory,
  };
  timeline.show(source, 0);
  const mayBegin = () => timeline.source === source && timeline.at === 0 && !timeline.isPlaying && !isStill.matches;
  const until = performance.now() + PATIENCE_MS;
  while (mayBegin() && performance.now() < until && !(await isViewOpen())) await new Promise((resolve) => setTimeout(resolve, WAIT_MS));
  if (mayBegin()) timeline.play();
}

function ended() {
  if (number + 1 >= ROUNDS * stories.length || document.hidden || isStill.matches) return;
  resting = setTimeout(() => {
    number += 1;
    play();
  }, REST_MS);
}

/** The story takes the place of the cameras, which show another table. */
function show(on) {
  byId("story-foot").hidden = byId("story-goal").hidden = byId("story-now").hidden = !on;
  byId("cameras").hidden = on;
}

function open() {
  if (!stories.length || isOn) return;
  isOn = true;
  show(true);
  play();
}

/** Ends the story; the live table is on view again, and the episode that runs. */
function closeStory() {
  if (!isOn) return;
  isOn = false;
  clearTimeout(resting);
  show(false);
  sessionStorage.setItem(SEEN, "1");
  timeline.close();
  showRunning();
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
const hasOtherPlans = () => LIVE.has(known("episode")?.state) || Boolean(known("opened"));

export async function setUpStory() {
  const run = byId("story-run");
  run.addEventListener("click", () => act(run, runLive));
  byId("story-photo").addEventListener("click", usePhoto);
  byId("story-lamp").addEventListener("click", moveLamp);
  byId("story-button").addEventListener("click", open);
  watch("episode", (job) => { run.hidden = LIVE.has(job?.state); });
  isOn = !byId("story-foot").hidden; // first-visit.js has made room
  const [answer] = await Promise.all([tellFailure(() => get("stories")), refreshObjects()]);
  // Those that can be run live come first.
  const answers = (answer?.stories ?? []).filter(({ outcome }) => outcome === "reached");
  const canRun = (one) => one.objects.every(isHere);
  stories = [...answers.filter(canRun), ...answers.filter((one) => !canRun(one))];
  byId("story-button").hidden = !stories.length;
  run.disabled = !stories.length;
  if (!isOn) return;
  if (stories.length && !hasOtherPlans()) {
    show(true);
    play();
  } else {
    isOn = false;
    show(false);
    byId("timeline-bar").hidden = !timeline.source;
    set("recorded", known("recorded")); // for what made room for the story
  }
}
