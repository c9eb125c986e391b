// A push that is tried: dragged in the 3D view or toward the nearest object, predicted, carried out and compared.
import { post, put, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { LIVE } from "./jobs.js";
import { current, inWords, known, watch } from "./state.js";
import { act } from "./toasts.js";

const STILL = 0.05; // mm, deg; less is not worth a number
const DRAWN = new Set(["predicted", "executing", "executed"]);
const digits = (value) => (value < 9.95 ? value.toFixed(1) : value.toFixed(0));
const motion = (mm, deg) => (mm < STILL && deg < STILL ? "still" : `${digits(mm)} mm, ${digits(deg)}°`);
const isStill = ({ predicted_mm: mm, predicted_deg: deg, went_mm: went, turned_deg: turned }) => Math.max(mm, deg, went ?? 0, turned ?? 0) < 1;
const moves = ({ predicted_mm: mm, predicted_deg: deg }) => mm >= 3 || deg >= 3; // as purple ghosts do

function told(push) {
  if (!push) return "Drag the pusher at an object in the 3D view.";
  if (push.problem) return inWords(push.problem);
  if (push.state === "predicting") return push.is_warm ? "Predicting" : "Loading the network, some seconds the first time";
  if (push.state === "executing") return "Pushing";
  if (push.state === "executed") return "Pushed. Purple: predicted; black: the true ways.";
  const count = push.objects.filter(moves).length;
  return `${count || "Nothing"}${count ? ` object${count > 1 ? "s" : ""}` : ""} will move; predicted in ${(1000 * push.took_s).toFixed(0)} ms`;
}

function row(one) {
  const cells = [motion(one.predicted_mm, one.predicted_deg)];
  if (one.off_mm !== null) cells.push(motion(one.went_mm, one.turned_deg), motion(one.off_mm, one.off_deg));
  const line = el("tr", {}, el("td", { textContent: one.label }), ...cells.map((textContent) => el("td", { textContent })));
  line.dataset.object = one.name;
  return line;
}

function draw() {
  const push = known("push");
  const isRecorded = known("recorded") || !byId("story-foot").hidden; // or will be
  byId("push-bar").hidden = !current() || isRecorded || LIVE.has(known("episode")?.state);
  byId("push-told").textContent = told(push);
  byId("push-execute").hidden = push?.state !== "predicted";
  byId("push-clear").hidden = !push;
  const isTried = push?.state === "executed";
  const rows = DRAWN.has(push?.state) ? push.objects.filter((one) => !isStill(one)) : [];
  byId("push-report").hidden = !rows.length;
  byId("push-report").classList.toggle("is-tried", isTried);
  byId("push-rows").replaceChildren(...rows.map(row));
}

export function setUpPredictedPush() {
  const on = (id, action) => byId(id).addEventListener("click", () => act(byId(id), action));
  on("push-nearest", () => put("push", {}));
  on("push-execute", () => post("push/execute"));
  on("push-clear", () => remove("push"));
  for (const what of ["push", "scene", "episode", "recorded"]) watch(what, draw);
}
