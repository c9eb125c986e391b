// The goal: an image of how the table should look. Uploaded, drawn at random, composed, or one of the earlier ones.
import { getAll, post, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { mayDrive } from "./driver.js";
import { current, known, set, watch } from "./state.js";
import { act, tellFailure, tellMissingScene } from "./toasts.js";

const DRAWN_SEEDS = 1_000_000; // short to read, and far fewer than may be asked for
const CHOSEN = "osf-goal"; // what this page has chosen outlives a reload of it
const remembered = JSON.parse(sessionStorage.getItem(CHOSEN) ?? "{}");
let pickedFor = remembered.scene ?? null; // the scene for which a goal of another table was chosen by hand

/** The address of a goal's image, another one after it was cropped. */
export const imageOf = (goal) =>
  `api/goals/${encodeURIComponent(goal.id)}/image.png${goal.photo ? `?${new URLSearchParams(goal.photo.crop)}` : ""}`;

const fits = (goal, scene) => goal.source === "upload" || !goal.scene || goal.scene === scene?.id || pickedFor === scene?.id;

/** Adds a goal that was just made, and chooses it. */
export function takeGoal(goal) {
  pickedFor = current()?.id ?? null;
  set("goals", [goal, ...known("goals").filter((other) => other.id !== goal.id)]);
  set("goal", goal);
}

export async function refreshGoals() {
  const goals = await tellFailure(() => getAll("goals", "goals"));
  if (goals) set("goals", goals);
}

/** Keeps the goal that was chosen if it is there still and fits the table; else takes the newest made for it. */
function settle() {
  const scene = current();
  if (scene === undefined) return;
  const goals = known("goals");
  const chosen = goals.find((goal) => goal.id === (known("goal")?.id ?? remembered.goal));
  const next = chosen && fits(chosen, scene) ? chosen : goals.find((goal) => scene && goal.scene === scene.id) ?? null;
  if (next !== known("goal")) set("goal", next);
}

export function randomGoal() {
  const scene = current();
  if (!scene) return tellMissingScene();
  if (!mayDrive()) return undefined;
  const seed = Math.floor(Math.random() * DRAWN_SEEDS);
  return act(byId("random-goal"), async () =>
    takeGoal(await post("goals", { scene: scene.id, random: { seed, moved: null }, name: `Random goal ${seed}` })));
}

// Drawing

const ORIGINS = { drawn: "Drawn at random", composed: "Composed by hand", photo: "Your photo; where things lie was found in it" };

function originText(goal, scene) {
  const origin = ORIGINS[goal.source] ?? "Uploaded; where things go is read from the photo";
  return goal.scene && goal.scene !== scene?.id ? `${origin}, for another table` : origin;
}

function draw(goal) {
  if (goal) sessionStorage.setItem(CHOSEN, JSON.stringify({ goal: goal.id, scene: pickedFor }));
  const image = byId("goal-image");
  image.hidden = !goal;
  if (goal) image.src = imageOf(goal);
  else image.removeAttribute("src");
  image.alt = goal ? `Goal: ${goal.name}` : "";
  byId("goal-drop").classList.toggle("filled", Boolean(goal));
  byId("goal-name").textContent = goal?.name ?? "not chosen yet";
  byId("goal-origin").textContent = goal
    ? originText(goal, current()) : "What should the table look like? The examples above bring a goal with them.";
  byId("delete-goal").hidden = !goal;
  drawEarlier();
}

function drawEarlier() {
  const scene = current();
  const goals = known("goals");
  const option = (goal) => el("option", { value: goal.id, textContent: goal.name, title: ORIGINS[goal.source] ?? "Uploaded" });
  const here = goals.filter((goal) => !goal.scene || goal.scene === scene?.id);
  const elsewhere = goals.filter((goal) => !here.includes(goal));
  const select = byId("goal-select");
  select.replaceChildren(
    el("option", { value: "", textContent: "choose one" }),
    ...here.map(option),
    elsewhere.length ? el("optgroup", { label: "Made for other tables" }, ...elsewhere.map(option)) : "",
  );
  select.value = known("goal")?.id ?? "";
  byId("earlier").hidden = !goals.length;
}

export function setUpGoals() {
  byId("random-goal").addEventListener("click", randomGoal);
  byId("goal-select").addEventListener("change", (event) => {
    pickedFor = current()?.id ?? null;
    set("goal", known("goals").find((goal) => goal.id === event.target.value) ?? null);
  });
  doubted(byId("delete-goal"), "Really delete", async () => {
    await remove(`goals/${encodeURIComponent(known("goal").id)}`);
    await refreshGoals();
  });
  byId("goal-image").addEventListener("error", () => { byId("goal-image").hidden = true; });
  byId("goal-image").addEventListener("load", () => { byId("goal-image").hidden = false; });
  let shown;
  watch("scene", (scene) => {
    if (scene?.id === shown) return;
    shown = scene?.id;
    settle();
    drawEarlier();
  });
  watch("goals", () => {
    settle();
    drawEarlier();
  });
  watch("goal", draw);
  watch("draft", (draft) => { if (!draft) draw(known("goal")); });
}
