// Keys of the whole page, in the 3D view too; none of them while typing or while a dialog is open, or where they are off.
import { toggleMasks } from "./cameras.js";
import { compose } from "./compose.js";
import { byId } from "./dom.js";
import { cancelEpisode, resetTable, startEpisode, stepOnce, togglePause } from "./episode.js";
import { randomGoal } from "./goals.js";
import { LIVE } from "./jobs.js";
import { pushKey } from "./push.js";
import { stopKey } from "./robot.js";
import { anotherScene } from "./scenes.js";
import { known } from "./state.js";
import { timeline } from "./timeline.js";

const OFF = "osf-keys-off";

// Radio buttons and sliders need the arrows themselves; a checkbox needs no key of ours.
const isTyping = (target) => Boolean(target.closest?.("input:not([type=checkbox]), select, textarea, video, [role=tab]"));
const isDialogOpen = () => document.querySelector("dialog[open]") !== null;

// Space presses what has the focus.
const isPressed = (target) => Boolean(target.closest?.("button, a, summary, input, [tabindex]:not([role=tabpanel])"));

// What ends or replaces something wants Shift as well, so that no single letter does it by accident.
const COMMANDS = {
  s: () => startEpisode(),
  " ": () => (LIVE.has(known("episode")?.state) ? togglePause() : timeline.toggle()),
  ".": stepOnce,
  X: cancelEpisode,
  R: resetTable,
  g: randomGoal,
  c: compose,
  N: () => anotherScene(),
  m: () => toggleMasks(),
  "?": () => byId("help-dialog").showModal(),
};
const OF_VIEW = ["w", "a", "s", "d", "q", "e"]; // move the camera where the 3D view has the focus, as the arrows do

const isOff = () => localStorage.getItem(OFF) === "1";

// Caps Lock alone makes capitals, too.
const isMeant = ({ key, shiftKey }) => key in COMMANDS && (!/^[A-Z]$/.test(key) || shiftKey);

function take(event) {
  if (!isMeant(event) || event.repeat) return;
  event.preventDefault();
  COMMANDS[event.key]();
}

const isPlain = (event) => !(event.ctrlKey || event.metaKey || event.altKey || isOff() || isDialogOpen());

function down(event) {
  if (event.defaultPrevented || !isPlain(event) || isTyping(event.target) || (event.key === " " && isPressed(event.target))) return;
  if (!known("recorded") && byId("photo-stage").hidden && pushKey(event.key, true)) event.preventDefault();
  else take(event);
}

/** The frame of the 3D view has events of its own, and is loaded again now and then. */
function listenInView() {
  const view = byId("viewer");
  view.addEventListener("load", () => view.contentWindow.addEventListener("keydown", stopKey, true));
  view.addEventListener("load", () => view.contentWindow.addEventListener("keydown", (event) => {
    const isOwn = OF_VIEW.includes(event.key) || (event.key === " " && isPressed(event.target));
    if (isPlain(event) && !isTyping(event.target) && !isOwn) take(event);
  }));
}

export function setUpKeyboard() {
  window.addEventListener("keydown", down);
  window.addEventListener("keyup", (event) => pushKey(event.key, false));
  listenInView();
  byId("help-button").addEventListener("click", () => byId("help-dialog").showModal());
  const box = byId("keys-on");
  box.checked = !isOff();
  box.addEventListener("change", () => (box.checked ? localStorage.removeItem(OFF) : localStorage.setItem(OFF, "1")));
}
