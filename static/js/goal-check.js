// Whether the chosen goal suits the table, asked as soon as either changes; what is wrong stands beside what mends it.
import { get, post } from "./api.js";
import { byId } from "./dom.js";
import { openCrop } from "./crop.js";
import { current, known, set, watch } from "./state.js";
import { forgetDoubts } from "./episode-settings.js";
import { act } from "./toasts.js";

let asked = ""; // which goal, crop and table the answer is of, or will be

async function look() {
  const [goal, scene] = [known("goal"), current()];
  const key = goal && scene ? JSON.stringify([goal.id, goal.photo, scene.id]) : "";
  if (key === asked) return;
  asked = key;
  forgetDoubts();
  if (!key || goal.scene === scene.id) {
    set("check", null);
    return;
  }
  set("check", { verdict: "looking", text: "Looking whether the photo shows what is on the table.", refused: false, scene: null });
  let check = null;
  try {
    check = await get(`goals/${encodeURIComponent(goal.id)}/check?${new URLSearchParams({ scene: scene.id })}`);
  } catch {
    // Start checks again, and tells what is wrong
  }
  if (key === asked) set("check", check);
}

function draw(check) {
  const isWrong = Boolean(check?.text) && check.verdict !== "looking";
  byId("goal-check").hidden = !check?.text;
  byId("goal-check").dataset.level = check?.refused ? "error" : isWrong ? "warning" : "info";
  byId("goal-check-text").textContent = check?.text ?? "";
  byId("goal-check-do").hidden = !isWrong;
  byId("check-crop").hidden = byId("check-mark").hidden = !known("goal")?.photo;
  byId("check-table").hidden = !check?.scene;
  byId("check-photo").hidden = Boolean(check?.scene);
  byId("check-doubt").hidden = check?.verdict === "other table";
}

export function setUpGoalCheck() {
  byId("check-crop").addEventListener("click", openCrop);
  byId("check-photo").addEventListener("click", () => byId("goal-file").click());
  byId("check-table").addEventListener("click", () => act(byId("check-table"), async () => {
    set("scene", await post(`scenes/${known("check").scene}/activate`));
  }));
  watch("goal", look);
  watch("scene", look);
  watch("check", draw);
}
