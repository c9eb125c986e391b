// Composing a goal: golden objects are dragged in the 3D view or on a map, and the goal image follows.
import { patch, post, remove } from "./api.js";
import { LatestImage } from "./cameras.js";
import { byId } from "./dom.js";
import { isDriving, mayDrive } from "./driver.js";
import { takeGoal } from "./goals.js";
import { TableMap } from "./map.js";
import { Newest } from "./newest.js";
import { current, inWords, known, labelOf, set, watch } from "./state.js";
import { scrollTo } from "./tabs.js";
import { act, tellMissingScene } from "./toasts.js";

const picture = new LatestImage(byId("draft-image"));
const moves = new Newest(async (objects) => {
  const poses = objects.map(({ name, position, quaternion }) => ({ name, position, quaternion }));
  const draft = await patch("goals/draft", { objects: poses });
  if (known("draft")) set("draft", draft); // unless it was stopped meanwhile
});
let map = null;
let pictured = ""; // the draft whose image is shown

export function compose() {
  const scene = current();
  if (!scene) return tellMissingScene();
  if (!mayDrive()) return undefined;
  return act(byId("compose"), async () => {
    const draft = await post("goals/draft", { scene: scene.id });
    set("draft", null); // it may count from the beginning again
    set("draft", draft);
  });
}

async function save() {
  const goal = await post("goals/draft/save", { name: byId("draft-name").value.trim() || "My goal" });
  set("draft", null);
  byId("draft-name").value = "";
  takeGoal(goal);
}

async function stop() {
  await remove("goals/draft");
  set("draft", null);
}

function draw(draft) {
  const isNew = byId("composing").hidden;
  byId("composing").hidden = !draft;
  byId("goal-choice").hidden = Boolean(draft);
  if (!draft) {
    pictured = "";
    picture.clear();
    return;
  }
  if (isNew) {
    byId("goal-card").open = true;
    scrollTo(byId("goal-card"));
  }
  byId("goal-name").textContent = "being composed";
  byId("draft-problem").textContent = inWords(draft.problem);
  byId("save-draft").disabled = Boolean(draft.problem);
  // What the hand does now counts more than what comes back.
  if (!map.isDragging && !moves.isBusy) map.show(draft.objects);
  const key = `${draft.scene} ${draft.revision}`;
  if (key !== pictured) picture.show(`api/goals/draft/image.png?v=${draft.revision}`);
  pictured = key;
}

export function setUpCompose() {
  map = new TableMap(byId("goal-map"), {
    onChange: (objects) => moves.ask(objects),
    onChoose: (object) => { byId("map-chosen").textContent = object ? labelOf(object.name) : ""; },
    mayMove: () => mayDrive(),
  });
  byId("compose").addEventListener("click", compose);
  byId("turn-left").addEventListener("click", () => map.turn(1));
  byId("turn-right").addEventListener("click", () => map.turn(-1));
  for (const [id, action] of [["save-draft", save], ["stop-draft", stop]]) {
    byId(id).addEventListener("click", () => act(byId(id), action));
  }
  byId("draft-name").addEventListener("keydown", (event) => { if (event.key === "Enter") byId("save-draft").click(); });
  watch("draft", draw);
  watch("driver", () => byId("goal-map").classList.toggle("still", !isDriving()));
  watch("scene", () => map.showNow(current()?.objects ?? []));
  watch("objects", () => {
    map.showNow(current()?.objects ?? []);
    if (known("draft")) map.show(known("draft").objects);
  });
}
