// Examples to begin with: one click lays the table and chooses the goal.
import { get, post } from "./api.js";
import { byId, el, whileDisabled } from "./dom.js";
import { prepareTraining } from "./fields.js";
import { takeGoal } from "./goals.js";
import { fetchObjects } from "./objects.js";
import { anotherScene, refreshScenes } from "./scenes.js";
import { current, labelOf, objects, set, watch } from "./state.js";
import { tellFailure } from "./toasts.js";

let isBusy = false;
let drawn = ""; // what the tiles show, so that they stay under the pointer while nothing has changed

async function choose(preset, tile) {
  if (isBusy) return;
  isBusy = true;
  tile.setAttribute("aria-busy", "true");
  byId("preset-list").classList.add("busy");
  await tellFailure(async () => {
    const { scene, goal } = await post(`presets/${encodeURIComponent(preset.id)}`);
    set("scene", { ...scene, is_current: true });
    takeGoal(goal);
    await refreshScenes();
  }, tile);
  byId("preset-list").classList.remove("busy");
  tile.removeAttribute("aria-busy");
  isBusy = false;
}

/** What an example needs: its objects' meshes, else a field. */
function getMissing(names, tile) {
  const absent = objects().filter(({ name, available }) => names.includes(name) && !available).map(({ name }) => name);
  return absent.length ? fetchObjects(tile, absent) : prepareTraining(names[0]);
}

function tile(preset) {
  const picture = preset.image
    ? el("img", { src: preset.image, alt: "", width: 112, height: 84 })
    : el("span", { className: "no-picture", textContent: preset.objects });
  const button = el(
    "button", { type: "button", title: preset.text }, picture,
    el("span", { className: "title", textContent: preset.title }),
    preset.missing?.length
      ? el("span", { className: "missing", textContent: `Fetch ${preset.missing.map(labelOf).join(", ")} first` })
      : el("span", { className: "hint", textContent: preset.text }),
  );
  button.dataset.preset = preset.id;
  button.addEventListener("click", () => (preset.missing?.length ? getMissing(preset.missing, button) : choose(preset, button)));
  return el("li", {}, button);
}

async function refreshPresets() {
  const answer = await tellFailure(() => get("presets"));
  byId("no-presets").hidden = Boolean(answer?.presets.length);
  const now = JSON.stringify(answer?.presets ?? []);
  if (answer && now !== drawn) byId("preset-list").replaceChildren(...answer.presets.map(tile));
  if (answer) drawn = now;
}

export function setUpPresets() {
  const count = byId("table-count");
  const another = byId("another-table");
  another.addEventListener("click", () => {
    if (count.reportValidity()) whileDisabled(another, () => anotherScene(another, count.valueAsNumber));
  });
  // What is missing may have been fetched or trained by now.
  watch("objects", (objects) => { if (objects.length) refreshPresets(); });
  watch("fields", (fields) => { if (fields) refreshPresets(); });
  let shown;
  watch("scene", () => {
    const scene = current();
    byId("table-facts").textContent = scene ? scene.objects.map((object) => object.label).join(", ") : "";
    byId("table-facts").title = byId("table-facts").textContent;
    if (scene && scene.id !== shown) count.value = scene.objects.length;
    shown = scene?.id;
  });
}
