// "Try to fool it": what nobody tells the program while it works, and what it notices, large over the scene.
import { post } from "./api.js";
import { byId, whileDisabled } from "./dom.js";
import { mayDrive } from "./driver.js";
import { LIVE } from "./jobs.js";
import { current, inWords, known, set, watch } from "./state.js";
import { tellFailure } from "./toasts.js";

const isDone = new Map(); // whether the light is dimmed and a camera covered
const SHOWN_MS = 6000;
const UNDO = { "dim light": "Brighten it again", "cover camera": "Uncover the camera" }; // what pressing it once more does
const KINDS = { "fool-turn": "turn lamp", "fool-dim": "dim light", "fool-nudge": "nudge object", "fool-cover": "cover camera" };
const LABELS = Object.fromEntries(Object.keys(KINDS).map((id) => [id, byId(id).textContent]));
const WORTH = ["lamp", "object", "lost", "found", "camera", "brightness"]; // matters that are told large
let told = { episode: "", count: 0 };
let timer = 0;

const isRunning = () => {
  const job = known("episode");
  return ["running", "paused"].includes(job?.state) && job.params?.scene === current()?.id;
};

function drawLabels() {
  for (const [id, kind] of Object.entries(KINDS)) byId(id).textContent = isDone.get(kind) ? UNDO[kind] : LABELS[id];
}

/** Large over the scene, for some seconds: what was done, or what was noticed. */
function tell(text, isNoticed) {
  const box = byId("noticed-large");
  box.hidden = false;
  box.textContent = text;
  box.classList.toggle("by-hand", !isNoticed);
  clearTimeout(timer);
  timer = setTimeout(() => { box.hidden = true; }, SHOWN_MS);
}

async function disturb(kind, button) {
  const scene = current();
  if (!scene || !mayDrive()) return;
  const done = await tellFailure(() => post(`scenes/${scene.id}/disturbances`, { kind }), button);
  if (!done) return;
  set("scene", { ...done.scene, is_current: true });
  if (kind in UNDO) {
    isDone.set(kind, !isDone.get(kind));
    drawLabels();
  }
  tell(`You: ${inWords(done.text)}`, false);
}

/** Tells notices of the episode on view that are new. */
function follow(report) {
  if (!report) return;
  const notices = report.notices ?? [];
  const isOther = told.episode !== report.id;
  const fresh = isOther ? [] : notices.slice(told.count).filter(({ matter }) => WORTH.includes(matter));
  told = { episode: report.id, count: notices.length };
  if (fresh.length && LIVE.has(report.status)) tell(inWords(fresh.at(-1).text), true);
}

export function setUpFool() {
  for (const [id, kind] of Object.entries(KINDS)) {
    byId(id).addEventListener("click", () => whileDisabled(byId(id), () => disturb(kind, byId(id))));
  }
  const draw = () => {
    byId("fool").hidden = !isRunning();
    if (isRunning()) return;
    isDone.clear(); // all of it ends with the episode
    drawLabels();
  };
  watch("episode", draw);
  watch("scene", draw);
  watch("report", follow);
}
