// New scenes and the list of those there are.
import { getAll, post, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { current, set, watch } from "./state.js";
import { act, tellFailure, toast } from "./toasts.js";

const MOST_OBJECTS = 8;
const form = () => byId("new-scene");
const randomSeed = () => Math.floor(Math.random() * 1_000_000); // short to read

function chosenObjects() {
  return [...byId("chips").querySelectorAll("input:checked")].map((box) => box.value);
}

/** A scene as asked for, shown at once. */
export async function makeScene(body) {
  const scene = await post("scenes", body);
  set("scene", { ...scene, is_current: true });
  await refreshScenes();
}

async function submit(event) {
  event.preventDefault();
  const fields = form().elements;
  const body = { seed: Number(fields.seed.value) };
  if (fields.which.value === "chosen") {
    body.objects = chosenObjects();
    if (!body.objects.length) return toast("Choose at least one object.", "warning");
  } else {
    body.count = Number(fields.count.value);
  }
  if (fields["own-light"].checked && current()) body.light = { position: current().light.position };
  return act(form().querySelector("[type=submit]"), () => makeScene(body));
}

/** Another random scene, with as many objects as this one if nothing else is said; `near` is what asks for it. */
export function anotherScene(near = null, count = current()?.objects.length ?? Number(form().elements.count.value)) {
  const seed = randomSeed();
  form().elements.seed.value = seed;
  return tellFailure(() => makeScene({ seed, count }), near);
}

export function resetScene() {
  const scene = current();
  if (!scene) return undefined;
  return act(byId("reset"), async () => set("scene", { ...(await post(`scenes/${scene.id}/reset`)), is_current: true }));
}

function entry(scene) {
  const show = el("button", { type: "button", className: "plain", textContent: "Show" });
  show.addEventListener("click", () => act(show, async () => {
    set("scene", await post(`scenes/${scene.id}/activate`));
    await refreshScenes();
  }));
  const drop = doubted(el("button", { type: "button", className: "plain danger", textContent: "Delete" }), "Really delete", async () => {
    await remove(`scenes/${scene.id}`);
    await refreshScenes();
  });
  const names = scene.objects.map((object) => object.label).join(", ");
  const made = new Date(scene.created_at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  return el(
    "li",
    {},
    el("span", { className: "title", textContent: names || "Empty table" }),
    el("span", { className: "hint", textContent: `Seed ${scene.seed}, made ${made}` }),
    el("div", { className: "actions" }, scene.is_current ? el("span", { className: "current", textContent: "Shown now" }) : show, drop),
  );
}

export async function refreshScenes() {
  const scenes = await tellFailure(() => getAll("scenes", "scenes"));
  if (!scenes) return;
  byId("no-scenes").hidden = scenes.length > 0;
  byId("scene-list").replaceChildren(...scenes.reverse().map(entry));
}

export function setUpScenes() {
  form().addEventListener("submit", submit);
  form().addEventListener("change", () => {
    const isChosen = form().elements.which.value === "chosen";
    byId("chips").hidden = !isChosen;
    byId("count-field").hidden = isChosen;
    const boxes = [...byId("chips").querySelectorAll("input")];
    const isFull = boxes.filter((box) => box.checked).length >= MOST_OBJECTS;
    for (const box of boxes) box.disabled = isFull && !box.checked;
  });
  byId("dice").addEventListener("click", () => { form().elements.seed.value = randomSeed(); });
  byId("reset").addEventListener("click", resetScene);
  let [shown, offered] = [undefined, ""];
  watch("scene", (scene) => {
    if (scene === undefined || (scene?.id ?? null) === shown) return;
    shown = scene?.id ?? null;
    refreshScenes();
  });
  watch("objects", (objects) => {
    const there = objects.filter((object) => object.available);
    const names = there.map(({ name }) => name).join();
    if (names !== offered) byId("chips").replaceChildren(...there.map((object) => el(
      "label", {}, el("input", { type: "checkbox", value: object.name }), el("span", { textContent: object.label }),
    )));
    offered = names; // what was chosen stays while they are the same
    const { count } = form().elements;
    if (there.length) {
      count.max = Math.min(MOST_OBJECTS, there.length);
      if (Number(count.value) > Number(count.max)) count.value = count.max;
    }
    byId("no-objects").hidden = !objects.length || there.length > 0;
  });
}
