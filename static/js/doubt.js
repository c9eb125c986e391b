// What cannot be undone is asked for twice.
import { whileDisabled } from "./dom.js";
import { tellFailure } from "./toasts.js";

const DOUBT_MS = 4000;

/** A button that asks once more before it does what cannot be undone. */
export function doubted(button, text, action) {
  const sure = button.textContent;
  button.addEventListener("click", () => {
    if (button.textContent === sure) {
      button.textContent = text;
      setTimeout(() => { button.textContent = sure; }, DOUBT_MS);
    } else {
      whileDisabled(button, () => tellFailure(action));
    }
  });
  return button;
}
