// What is told: failures beside what caused them, everything else in the corner.
import { byId, el, whileDisabled } from "./dom.js";
import { inWords, watch } from "./state.js";

const LIFE_MS = 6000;
const MOST = 4;
const GROUPS = ".row, .with-button, .controls, .goal, .presets, .story-buttons, .fool, .actions, .entry-buttons"; // after which it stands
const AREAS = ".card, .story-foot, .fool, .bar, dialog"; // in which a new try settles it
const [UNREACHABLE, CONFLICT] = [0, 409]; // statuses of an ApiError

export function toast(sentence, level = "info") {
  const text = inWords(sentence);
  const box = byId("toasts");
  for (const old of box.children) if (old.firstChild.textContent === text) old.remove();
  while (box.children.length >= MOST) box.firstChild.remove();
  const close = el("button", { type: "button", textContent: "✕", attributes: { "aria-label": "Close message" } });
  const node = el("div", { className: `toast ${level}-toast` }, el("span", { textContent: text }), close);
  close.addEventListener("click", () => node.remove());
  box.append(node);
  if (level !== "error") setTimeout(() => node.remove(), LIFE_MS);
  return node;
}

/** Removes what was told of failures in an area, of one status, or all of it. */
function settle({ area = document, status }) {
  for (const told of area.querySelectorAll("[data-failed]")) if (status === undefined || Number(told.dataset.failed) === status) told.remove();
}

/** The service can be reached again. */
export const settleUnreachable = () => settle({ status: UNREACHABLE });

function tell(error, near) {
  const isSeen = near?.checkVisibility?.() && !near.closest("fieldset:disabled");
  const node = isSeen ? el("p", { className: "error beside-cause", textContent: inWords(error.message), attributes: { role: "alert" } }) : toast(error.message, "error");
  node.dataset.failed = error.status ?? -1;
  if (!isSeen) return;
  (near.closest(GROUPS) ?? near).after(node);
  node.scrollIntoView({ block: "nearest" });
}

/** Runs an action; a failure is told beside what caused it, `near`, until it is tried again, or else in the corner. */
export async function tellFailure(action, near = null) {
  const area = near?.closest(AREAS);
  if (area) settle({ area });
  try {
    return await action();
  } catch (error) {
    tell(error, near);
    return undefined;
  }
}

/** Runs the action of a button, which rests meanwhile; a failure is told beside it. */
export const act = (button, action) => whileDisabled(button, () => tellFailure(action, button));

export function tellMissingScene() {
  toast("There is no scene yet; make one in Lab, under Scenes.", "warning");
}

export function setUpToasts() {
  // What was refused to a page that only watched, and what was wrong with another table or goal, is settled.
  for (const what of ["driver", "goal"]) watch(what, () => settle({ status: CONFLICT }));
}
