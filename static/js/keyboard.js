// Keys of the whole page; none of them while typing or while a dialog is open.
import { toggleMasks } from "./cameras.js";
import { compose } from "./compose.js";
import { byId } from "./dom.js";
import { cancelEpisode, resetTable, startEpisode, stepOnce, togglePause } from "./episode.js";
import { randomGoal } from "./goals.js";
import { pushKey } from "./push.js";
import { anotherScene } from "./scenes.js";

// Radio buttons and sliders need the arrows themselves; a checkbox needs no key of ours.
const isTyping = (target) => Boolean(target.closest?.("input:not([type=checkbox]), select, textarea, video, [role=tab]"));
const isDialogOpen = () => document.querySelector("dialog[open]") !== null;

// Space presses what has the focus.
const isPressed = (target) => Boolean(target.closest?.("button, a, summary, input, [tabindex]"));

const COMMANDS = {
  s: () => startEpisode(),
  " ": togglePause,
  ".": stepOnce,
  x: cancelEpisode,
  r: resetTable,
  g: randomGoal,
  c: compose,
  n: () => anotherScene(),
  m: () => toggleMasks(),
  "?": () => byId("help-dialog").showModal(),
};

export function setUpKeyboard() {
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || isDialogOpen() || isTyping(event.target)) return;
    if (event.key === " " && isPressed(event.target)) return;
    if (pushKey(event.key, true)) {
      event.preventDefault();
    } else if (event.key in COMMANDS && !event.repeat) {
      event.preventDefault();
      COMMANDS[event.key]();
    }
  });
  window.addEventListener("keyup", (event) => pushKey(event.key, false));
  byId("help-button").addEventListener("click", () => byId("help-dialog").showModal());
}
