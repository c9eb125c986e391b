// The catalogue: what there is, how big and heavy, and what is still to be fetched.
import { get, post } from "./api.js";
import { byId, el, whileDisabled } from "./dom.js";
import { objects, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { tellFailure } from "./toasts.js";

const FETCHABLE = 10; // as many as the package index has; more come from folders
const SYMMETRY = { none: "no symmetry", discrete: "discrete symmetry", continuous: "turns freely" };

function entry(object) {
  const size = object.size_m ? `${object.size_m.map((s) => (100 * s).toFixed(1)).join(" × ")} cm, ` : "";
  const facts = `${size}${(1000 * object.mass_kg).toFixed(0)} g, `;
  return el(
    "li",
    { className: object.available ? "" : "absent" },
    el("span", { className: "title", textContent: object.label, title: `${object.name}, ${object.licence}, ${object.attribution}` }),
    el(
      "span",
      { className: "hint" },
      facts,
      el("span", { textContent: SYMMETRY[object.symmetry.kind], title: object.symmetry.reason }),
      object.available ? "" : ", not fetched",
    ),
  );
}

export async function refreshObjects() {
  const answer = await tellFailure(() => get("objects"));
  if (answer) set("objects", answer.objects);
}

/** Starts the job that fetches objects and shows it. */
export function fetchObjects(button) {
  return whileDisabled(button, () => tellFailure(async () => {
    await post("jobs", { kind: "fetch_assets", params: {} });
    showTab("jobs");
  }));
}

export function setUpObjects() {
  const button = byId("fetch-objects");
  button.addEventListener("click", () => fetchObjects(button));
  watch("objects", () => {
    const there = objects().filter((object) => object.available).length;
    byId("object-list").replaceChildren(...objects().map(entry));
    byId("objects-hint").textContent = objects().length ? `${there} of ${objects().length} are on this machine.` : "";
    button.hidden = !objects().length || there >= FETCHABLE;
  });
}
