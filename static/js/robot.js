// A robot beside the simulated tables: which world is driven, an episode with it, permission for its first motion, a stop.
import { asked as askedOfAddress } from "./address.js";
import { get, post, upload } from "./api.js";
import { byId, el } from "./dom.js";
import { isDriving } from "./driver.js";
import { refreshGoals } from "./goals.js";
import { boxesFor, drawnBoxes, forgetBoxes, missingBoxes, setUpRobotBoxes } from "./robot-boxes.js";
import { setUpRobotCameras } from "./robot-cameras.js";
import { inWords, known, labelOf, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { act, tellFailure, toast } from "./toasts.js";

const BUSY = ["looking", "asked", "driving"];
const WORDS = { idle: "ready", looking: "looking, nothing moves", asked: "waiting for permission", driving: "moving", stopped: "stopped", lost: "connection lost" };
const PRESENCE_MS = 1000; // the service stops the robot after three of them without a word
const AGAIN_MS = 500;
const ABSENT_MS = 5000;
const NAME_MAX = 100;
let wanted = null; // the goal that was sent last
let isHeard = false; // whether the event stream is there
let allowed = null; // the episode that this page has let move
let isStopping = false;
let seen = "";
let heard = "";

const robot = () => known("robot");
const isBusy = () => BUSY.includes(robot()?.state);
/** Whether it moves now, or will before this page is told. */
const moves = () => robot()?.state === "driving" || (isBusy() && allowed === robot().episode?.id);

export async function refreshRobot() {
  try {
    set("robot", await get("robot"));
  } catch {
    // the event stream tells when the service is back
  }
}

/** Takes a job event; most of them change nothing about the robot. */
export function hearRobot(job) {
  if (job.kind !== "robot") return;
  const now = `${job.id} ${job.state} ${job.result?.drives} ${job.done}`;
  if (now !== heard) refreshRobot();
  else if (isBusy()) byId("robot-note").textContent = inWords(job.note); // once it was stopped, why is what counts
  heard = now;
}

/** The event stream is there, or lost: without it nobody here sees what the robot does. */
export function hearStream(isThere) {
  isHeard = isThere;
  if (isThere) refreshRobot();
  else if (moves()) toast("The connection to the service was lost. It stops the robot within three seconds, unless this page is back.", "error");
}

// Stopping

/** Tries until the service has answered; meanwhile this page no longer says that it is there, which stops the robot, too. */
export async function stopRobot() {
  if (isStopping) return;
  isStopping = true;
  byId("robot-bar-text").textContent = "Stopping";
  for (let isTold = false; !isTold; ) {
    try {
      set("robot", await post("robot/stop"));
      isTold = true;
    } catch (error) {
      toast(`${error.message} Without a word from this page the service stops the robot within three seconds.`, "error");
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  }
  isStopping = false;
  draw();
}

const isText = (target) => Boolean(target.closest?.("input:not([type=checkbox], [type=radio], [type=range]), textarea"));

/** Escape and Space, before anything else has them, and also where keys are switched off. */
export function stopKey(event) {
  if (!moves() || !(event.key === "Escape" || (event.key === " " && !isText(event.target)))) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  if (!event.repeat) stopRobot();
}

// Asking

function limitsText({ limits: { box: [x0, y0, x1, y1], top_speed_m_s: speed } }) {
  return `within x ${x0} to ${x1} m, y ${y0} to ${y1} m, no faster than ${speed} m/s`;
}

function drawDialog(now) {
  const dialog = byId("robot-dialog");
  const isWanted = now?.state === "asked" && isDriving() && allowed !== now.episode.id;
  if (!isWanted) {
    dialog.close();
    return;
  }
  const { params, result } = now.episode;
  byId("robot-dialog-title").textContent = `Move the robot at ${now.host}?`;
  byId("robot-what").textContent = `Its pusher will push ${params.names.map(labelOf).join(", ")} until the table looks like “${params.title}”, in ${params.settings.steps} pushes at most.`;
  byId("robot-limits").textContent = `It stays ${limitsText(now)}.`;
  byId("robot-doubts").replaceChildren(...(result?.doubts ?? []).map((text) => el("li", { textContent: inWords(text) })));
  if (!dialog.open) dialog.showModal();
}

async function allow() {
  const episode = robot().episode.id;
  allowed = episode;
  const now = await tellFailure(() => post("robot/confirmation", { episode }), byId("robot-allow"));
  if (now) set("robot", now);
  else allowed = null;
}

// Starting

const chosenNames = () => [...byId("robot-names").querySelectorAll("input:checked")].map((box) => box.value);
const fitting = () => known("goals").filter((goal) => robot().cameras.some(({ name }) => name === goal.camera.name) && goal.source === "upload");

/** Why no episode can start now; "" if one can. */
function reason() {
  if (!isDriving()) return "Someone else is driving; take over to start.";
  if (robot().state === "lost" && !robot().cameras.length) return "The robot does not answer.";
  if (isBusy()) return "It has an episode.";
  if (!chosenNames().length) return "Choose the objects on its table.";
  if (!byId("robot-goal").value) return "Choose a photo that one of its cameras took, without the pusher.";
  return missingBoxes();
}

function drawStart() {
  if (!robot()?.host) return;
  const why = reason();
  byId("robot-start").disabled = why !== "";
  byId("robot-reason").textContent = why || "It looks and plans; then it asks before anything moves.";
}

function chooseNames() {
  boxesFor(chosenNames());
  drawStart();
}

function drawChoices() {
  if (!robot()?.host) return;
  const names = (known("fields") ?? []).map(({ name }) => name);
  const chosen = chosenNames();
  byId("robot-names").replaceChildren(...names.map((name) =>
    el("label", {}, el("input", { type: "checkbox", value: name, checked: chosen.includes(name) }), labelOf(name))));
  const goal = byId("robot-goal");
  const before = wanted ?? goal.value;
  goal.replaceChildren(...fitting().map(({ id, name, camera }) => el("option", { value: id, textContent: `${name}, camera ${camera.name}`, selected: id === before })));
  const camera = byId("robot-camera");
  const cameras = robot().cameras.map(({ name }) => name);
  if (camera.options.length !== cameras.length) camera.replaceChildren(...cameras.map((name) => el("option", { value: name, textContent: name })));
  chooseNames();
}

async function uploadGoal() {
  const [file] = byId("robot-file").files;
  if (!file) return;
  const camera = robot().cameras.find(({ name }) => name === byId("robot-camera").value);
  const query = new URLSearchParams({ name: file.name.slice(-NAME_MAX), camera: JSON.stringify(camera) });
  await tellFailure(async () => {
    wanted = (await upload(`goals?${query}`, file, () => {}, "application/octet-stream")).id;
    await refreshGoals();
    wanted = null; // from now on it is the choice of whoever sits here
  }, byId("robot-file"));
  byId("robot-file").value = "";
}

const start = () => act(byId("robot-start"), async () => {
  if (!byId("robot-steps").reportValidity()) return;
  const asked = { goal: byId("robot-goal").value, names: chosenNames(), boxes: drawnBoxes(), settings: { steps: Number(byId("robot-steps").value) } };
  set("robot", await post("robot/episodes", asked));
  forgetBoxes();
});

// Drawing

/** The badge: which world the controls on view drive. */
function drawWorld() {
  const isRobot = Boolean(robot()?.host) && (isBusy() || !byId("panel-robot").hidden);
  byId("world").hidden = !robot()?.host;
  byId("robot-elsewhere").hidden = !isRobot;
  byId("world").textContent = isRobot ? `Robot at ${robot().host}: ${WORDS[robot().state]}` : "Simulated table";
  byId("world").dataset.state = { driving: "danger", lost: "lost", stopped: "lost" }[isRobot && robot().state] ?? "live";
}

function draw() {
  const now = robot();
  drawWorld();
  if (!now?.host) return;
  byId("tab-robot").hidden = false;
  byId("robot-host").textContent = now.host;
  byId("robot-state").textContent = WORDS[now.state];
  byId("robot-note").textContent = inWords(now.text);
  byId("robot-holds").textContent = now.limits ? `Its pusher stays ${limitsText(now)}; whoever started the service has said so.` : "";
  byId("robot-files").replaceChildren(...(now.episode?.files ?? []).map((name) =>
    el("a", { href: `api/jobs/${now.episode.id}/files/${encodeURIComponent(name)}`, textContent: name, download: name })));
  byId("robot-bar").hidden = !isBusy();
  if (!isStopping) byId("robot-bar-text").textContent = `Robot at ${now.host}: ${WORDS[now.state]}`;
  drawDialog(now);
  drawStart();
  const is = `${now.episode?.id} ${now.state}`;
  if (now.state === "lost" && seen && seen !== is) toast(now.text, "error");
  if (!seen && askedOfAddress().tab === "robot") showTab("robot");
  seen = is;
}

export function setUpRobot() {
  setUpRobotCameras();
  setUpRobotBoxes(drawStart);
  byId("robot-stop").addEventListener("click", stopRobot);
  byId("robot-allow").addEventListener("click", allow);
  byId("robot-refuse").addEventListener("click", stopRobot);
  byId("robot-dialog").addEventListener("cancel", (event) => {
    event.preventDefault(); // it closes when the service has said so
    stopRobot();
  });
  byId("robot-start").addEventListener("click", start);
  byId("robot-file").addEventListener("change", uploadGoal);
  byId("robot-names").addEventListener("change", chooseNames);
  byId("robot-goal").addEventListener("change", drawStart);
  window.addEventListener("keydown", stopKey, true);
  new MutationObserver(drawWorld).observe(byId("panel-robot"), { attributeFilter: ["hidden"] });
  watch("robot", draw);
  watch("robot", drawChoices);
  for (const what of ["fields", "objects", "goals", "goal", "driver"]) watch(what, drawChoices);
  watch("driver", () => drawDialog(robot()));
  setInterval(() => { if (moves() && isHeard && !isStopping) post("robot/presence").catch(() => {}); }, PRESENCE_MS);
  setInterval(() => { if (robot()?.state === "lost") refreshRobot(); }, ABSENT_MS);
}
