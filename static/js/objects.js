// The catalogue: what there is, how it looks from all around, how big and heavy, and what is still to be fetched.
import { get, post, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { prepareTraining } from "./fields.js";
import { showJob } from "./jobs.js";
import { putOnTable } from "./next-step.js";
import { known, objects, set, watch } from "./state.js";
import { scrollTo, showTab } from "./tabs.js";
import { act, tellFailure } from "./toasts.js";

const SIDE = 96; // of one view in a thumbnail [px]
const VIEWS = 24;
const SYMMETRY = { none: "", discrete: "discrete symmetry", continuous: "turns freely" };

/** The sides of a box in metres, in words. */
export const sizeText = (metres) => `${metres.map((side) => (100 * side).toFixed(1)).join(" × ")} cm`;

/** A mass in kilograms, in words. */
export const massText = (kg) => `${Number((1000 * kg).toPrecision(3))} g`;

/** All views side by side, of which the style sheet shows one after the other. */
function thumbnail(object) {
  if (!object.available) return el("span", { className: "turntable empty", attributes: { "aria-hidden": "true" } });
  const src = `api/objects/${encodeURIComponent(object.name)}/thumbnail.png?v=${object.version}`;
  const image = el("img", { loading: "lazy", alt: "", width: SIDE * VIEWS, height: SIDE, src });
  image.addEventListener("error", () => image.parentElement?.classList.add("empty"));
  return el("span", { className: "turntable", attributes: { "aria-hidden": "true" } }, image);
}

function facts(object) {
  const symmetry = el("span", { textContent: SYMMETRY[object.symmetry.kind], title: object.symmetry.reason });
  const weight = massText(object.mass_kg);
  return el("span", { className: "hint" }, object.size_m ? `${sizeText(object.size_m)}, ` : "", weight,
    symmetry.textContent ? ", " : "", symmetry, object.available ? "" : ", not on this machine");
}

async function deleteObject(object) {
  await remove(`objects/${encodeURIComponent(object.name)}`);
  await refreshObjects();
}

function button(text, label, action) {
  const made = el("button", { type: "button", className: "plain", textContent: text, attributes: { "aria-label": `${text}: ${label}` } });
  made.addEventListener("click", () => act(made, action));
  return made;
}

function fetchButton({ name, label }) {
  const made = el("button", { type: "button", className: "plain", textContent: "Fetch", attributes: { "aria-label": `Fetch: ${label}` } });
  made.addEventListener("click", () => fetchObjects(made, [name]));
  return made;
}

function actions(object) {
  const { label } = object;
  if (!object.available) return object.own ? [] : [fetchButton(object)];
  const buttons = [button("Put on the table", label, () => putOnTable(object.name))];
  if (!(known("fields") ?? []).some((field) => field.name === object.name)) {
    buttons.push(button("Train its field", label, () => prepareTraining(object.name)));
  }
  if (object.own) {
    const drop = el("button", { type: "button", className: "plain danger", textContent: "Delete", attributes: { "aria-label": `Delete: ${label}` } });
    buttons.push(doubted(drop, "Really delete", () => deleteObject(object)));
  }
  return buttons;
}

function entry(object) {
  const title = el("span", { className: "title", textContent: object.label, title: `${object.name}, ${object.licence}, ${object.attribution}` });
  const item = el("li", { className: "object" }, thumbnail(object),
    el("div", { className: "object-facts" }, title, facts(object), el("div", { className: "actions" }, ...actions(object))));
  item.dataset.object = object.name;
  return item;
}

export async function refreshObjects() {
  const answer = await tellFailure(() => get("objects"));
  if (answer) set("objects", answer.objects);
}

const missing = () => objects().filter((object) => !object.available && !object.own).map((object) => object.name);

/** Fetches some objects, the ten of the package index for none, and shows how that goes; `pressed` is what was pressed for it. */
export function fetchObjects(pressed, names = []) {
  return act(pressed, async () => {
    showJob(await post("jobs", { kind: "fetch_assets", params: { names } }));
    showTab("objects");
    scrollTo(byId("object-work"));
  });
}

let drawn = ""; // what the tiles show: those that turn, or are about to be pressed, stay where nothing has changed

function draw() {
  const now = JSON.stringify([objects(), (known("fields") ?? []).map(({ name }) => name)]);
  if (now === drawn) return;
  drawn = now;
  const there = objects().filter((object) => object.available).length;
  byId("object-list").replaceChildren(...objects().map(entry));
  byId("objects-hint").textContent = objects().length ? `${there} of ${objects().length} are on this machine.` : "";
  byId("fetch-objects").hidden = !missing().length;
}

export function setUpObjects() {
  const all = byId("fetch-objects");
  all.addEventListener("click", () => fetchObjects(all, missing()));
  byId("add-own").addEventListener("click", () => scrollTo(byId("new-object").closest(".card")));
  watch("objects", draw);
  watch("fields", draw);
}
