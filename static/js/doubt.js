// What cannot be undone is asked for twice.
import { act } from "./toasts.js";

const DOUBT_MS = 4000;

/** A button that asks once more before it does what cannot be undone. */
export function doubted(button, text, action) {
  const first = button.textContent;
  let timer = 0;
  const rest = () => {
    clearTimeout(timer);
    button.textContent = first;
  };
  button.addEventListener("click", () => {
    const isSure = button.textContent === text;
    rest();
    if (isSure) return act(button, action);
    button.textContent = text;
    timer = setTimeout(rest, DOUBT_MS);
    return undefined;
  });
  button.addEventListener("blur", rest);
  return button;
}
