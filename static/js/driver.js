// Who drives: of several visitors one page changes things; the others watch until they take over.
import { VISITOR, post } from "./api.js";
import { byId, el } from "./dom.js";
import { known, set, watch } from "./state.js";
import { act, toast } from "./toasts.js";

export function isDriving() {
  const driver = known("driver")?.driver;
  return !driver || driver === VISITOR;
}

/** Whether this page drives; if not, it is said. */
export function mayDrive() {
  if (!isDriving()) toast("Someone else is driving; take over first.", "warning");
  return isDriving();
}

/** Controls that a page which only watches cannot use. */
export const forDrivers = (...controls) => el("fieldset", { className: "drives wraps", disabled: !isDriving() }, ...controls);

function draw(driver) {
  const visitors = driver?.visitors ?? 1;
  byId("watching").hidden = visitors < 2;
  byId("watching").textContent = `${visitors} watching`;
  byId("driver-bar").hidden = isDriving();
  for (const controls of document.querySelectorAll("fieldset.drives")) controls.disabled = !isDriving();
}

export function setUpDriver() {
  const button = byId("take-over");
  button.addEventListener("click", () => act(button, async () => set("driver", await post("driver", { visitor: VISITOR }))));
  watch("driver", draw);
}
