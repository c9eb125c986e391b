// Messages in the corner. Errors stay until closed, others leave by themselves.
import { byId, el } from "./dom.js";
import { inWords } from "./state.js";

const LIFE_MS = 6000;
const MOST = 4;

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
}

/** Runs an action; a failure becomes a toast. */
export async function tellFailure(action) {
  try {
    return await action();
  } catch (error) {
    toast(error.message, "error");
    return undefined;
  }
}

export function tellMissingScene() {
  toast("There is no scene yet; make one under Scenes.", "warning");
}
