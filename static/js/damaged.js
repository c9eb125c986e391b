// What is damaged on the disk: why, and a way to delete it. Nothing else can be done with it.
import { get, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { tellFailure } from "./toasts.js";

const KINDS = { objects: "Object", goals: "Goal", photos: "Photo", "fields/sets": "Image set" };

function entry({ path, kind, id, reason }) {
  const drop = el("button", { type: "button", className: "plain danger", textContent: "Delete", attributes: { "aria-label": `Delete: damaged ${kind}` } });
  const act = async () => {
    await remove(`${path}/${encodeURIComponent(id)}`);
    await refreshDamaged();
  };
  return el("li", {}, el("span", { className: "title", textContent: kind, title: id }),
    el("span", { className: "hint", textContent: reason }), el("div", { className: "actions" }, doubted(drop, "Really delete", act)));
}

/** Asks the service what is damaged, and lists it. */
export async function refreshDamaged() {
  const lists = await tellFailure(() => Promise.all(Object.entries(KINDS).map(async ([path, kind]) => {
    const { damaged, objects = [] } = await get(path === "objects" ? path : `${path}?limit=1`);
    const again = objects.filter((object) => !object.own).map((object) => object.name); // offered in the catalogue
    return damaged.filter(({ id }) => !again.includes(id)).map((one) => ({ path, kind, ...one }));
  })));
  if (!lists) return;
  byId("damaged").hidden = !lists.flat().length;
  byId("damaged-list").replaceChildren(...lists.flat().map(entry));
}
