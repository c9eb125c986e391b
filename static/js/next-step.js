// What to do next with an object that is ready: put it on the table, then push it.
import { byId, el } from "./dom.js";
import { makeScene } from "./scenes.js";
import { current, labelOf } from "./state.js";
import { scrollTo, showTab } from "./tabs.js";
import { act, toast } from "./toasts.js";

const MOST_ON_TABLE = 8;

const isOnTable = (name) => Boolean(current()?.objects.some((object) => object.name === name));

/** Makes a table of what is there and one object more. */
export async function putOnTable(name) {
  const there = current()?.objects.map((object) => object.name) ?? [];
  if (isOnTable(name)) throw new Error(`${labelOf(name)} is on the table already.`);
  if (there.length >= MOST_ON_TABLE) throw new Error(`${MOST_ON_TABLE} objects are on the table, which is the most.`);
  const light = current() ? { light: { position: current().light.position } } : {};
  await makeScene({ objects: [...there, name], seed: Math.floor(Math.random() * 2 ** 31), ...light });
  toast(`${labelOf(name)} is on the table, in a scene of its own; the one before is kept in Lab, under Scenes.`);
}

function pushIt() {
  showTab("drive");
  scrollTo(byId("pad").closest(".card"));
  byId("pad").querySelector("button").focus({ preventScroll: true });
}

/** The button for the next step. */
export function nextStep(name) {
  const [text, action] = isOnTable(name) ? ["Push it", pushIt] : ["Put it on the table", () => putOnTable(name)];
  const button = el("button", { type: "button", className: "primary", textContent: text, attributes: { "aria-label": `${text}: ${labelOf(name)}` } });
  button.addEventListener("click", () => act(button, async () => action()));
  return button;
}

/** What the button for the next step depends on, so that it is drawn anew only when that has changed. */
export const stepKey = (name) => `${isOnTable(name)} ${labelOf(name)}`;
