// Pushing by hand: buttons and arrow keys, one action of 0.2 s at a time, as long as something is held.
import { post } from "./api.js";
import { byId, el } from "./dom.js";
import { current, set } from "./state.js";
import { tellMissingScene, toast } from "./toasts.js";

const STEP_MS = 200;
const PAD = [
  ["↖", -1, 1], ["↑", 0, 1], ["↗", 1, 1],
  ["←", -1, 0], null, ["→", 1, 0],
  ["↙", -1, -1], ["↓", 0, -1], ["↘", 1, -1],
];
const NAMES = { "0,1": "away", "0,-1": "closer", "1,0": "right", "-1,0": "left" };
const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowRight: [1, 0], ArrowLeft: [-1, 0] };

const held = new Map(); // what is held down -> direction
let isRunning = false;
let tapped = null; // pressed while an action ran and perhaps let go before its end

const speed = () => Number(byId("speed").value);

function direction() {
  const sum = [...held.values()].reduce(([x, y], [dx, dy]) => [x + dx, y + dy], [0, 0]);
  return [Math.sign(sum[0]), Math.sign(sum[1])];
}

/** Acts until nothing is held; a short tap still makes one whole action. */
async function run(first) {
  isRunning = true;
  let [x, y] = first;
  try {
    while (x || y) {
      const scene = current();
      if (!scene) {
        tellMissingScene();
        break;
      }
      const start = performance.now();
      const length = Math.max(Math.hypot(x, y), 1);
      const velocity = [(x * speed()) / length, (y * speed()) / length, 0];
      set("scene", { ...(await post(`scenes/${scene.id}/actions`, { actions: [velocity] })), is_current: true });
      await new Promise((resolve) => setTimeout(resolve, Math.max(STEP_MS - (performance.now() - start), 0)));
      const next = direction();
      [x, y] = next[0] || next[1] ? next : (tapped ?? next);
      tapped = null;
    }
  } catch (error) {
    held.clear();
    tapped = null;
    toast(error.message, "error");
  } finally {
    isRunning = false;
  }
}

export function press(what, way) {
  if (held.has(what)) return;
  held.set(what, way);
  if (isRunning) tapped = direction();
  else run(direction());
}

export const release = (what) => held.delete(what);
export const releaseAll = () => held.clear();

/** Whether the key is one that pushes; then it has been taken care of. */
export function pushKey(key, isDown) {
  if (!(key in KEYS)) return false;
  if (isDown) press(key, KEYS[key]);
  else release(key);
  return true;
}

export function setUpPush() {
  const pad = byId("pad");
  for (const entry of PAD) {
    if (!entry) {
      pad.append(el("span", { textContent: "push" }));
      continue;
    }
    const [arrow, x, y] = entry;
    const name = [NAMES[`0,${y}`], NAMES[`${x},0`]].filter(Boolean).join(" and ");
    const button = el("button", { type: "button", textContent: arrow, attributes: { "aria-label": `Push ${name}` } });
    const down = () => {
      button.classList.add("held");
      press(button, [x, y]);
    };
    const up = () => {
      button.classList.remove("held");
      release(button);
    };
    button.addEventListener("pointerdown", (event) => {
      if (event.button === 0) {
        button.setPointerCapture(event.pointerId);
        down();
      }
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(end, up);
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    button.addEventListener("keydown", (event) => { if (event.key === " " || event.key === "Enter") down(); });
    button.addEventListener("keyup", up);
    pad.append(button);
  }
  const tell = () => { byId("speed-value").textContent = `${(speed() * 100).toFixed(0)} cm/s`; };
  byId("speed").addEventListener("input", tell);
  tell();
  window.addEventListener("blur", releaseAll);
}
