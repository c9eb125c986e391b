// How an episode ended: before and after, what it came to in one line, what is missing, and what to do about it.
import { drawClip } from "./clip.js";
import { byId } from "./dom.js";
import { startEpisode } from "./episode.js";
import { LIVE } from "./jobs.js";
import { NOT_KNOWN, length, offsets, summary } from "./run-summary.js";
import { current, known, labelOf, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { toast } from "./toasts.js";

const NEAR_MM = 10; // further away than this, or turned by more, is what is told as missing
const TURNED_DEG = 8.6;
const MORE = 20;
let shown = null;

/** What is not as it should be, for each object. */
function missing({ objects, steps }) {
  const last = steps.at(-1);
  return objects.flatMap((name) => {
    const far = offsets(last)?.[name] ?? 0; // what is not known is not told as missing
    const turned = last.to_goal_deg?.[name] ?? 0;
    if (far <= NEAR_MM && turned <= TURNED_DEG) return [];
    const parts = [far > NEAR_MM && `${length(far)} away`, turned > TURNED_DEG && `turned by ${turned.toFixed(0)}°`].filter(Boolean);
    return [`${labelOf(name)} is still ${parts.join(" and ")}`];
  });
}

function why(episode) {
  if (episode.outcome === "refused") return "Nothing was moved, since the goal image is doubtful.";
  if (!offsets(episode.steps.at(-1))) return `How far things are from their goals is ${NOT_KNOWN}.`;
  const left = missing(episode);
  if (!left.length) return "";
  return `${left.join("; ")}.`;
}

/** Whether it can go on from where it ended. */
const canGoOn = ({ scene, outcome }) => scene === current()?.id && outcome !== "reached";

export function drawEnding(episode) {
  shown = episode;
  const isOver = !LIVE.has(episode.status) && episode.steps.length > 0;
  byId("ending").hidden = !isOver;
  if (!isOver) return;
  const frame = (step) => `api/episodes/${encodeURIComponent(episode.id)}/frames/${step}.png?part=now`;
  const [before, after] = [frame(0), frame(episode.steps.length - 1)];
  if (byId("ending-before").getAttribute("src") !== before) byId("ending-before").src = before;
  if (byId("ending-after").getAttribute("src") !== after) byId("ending-after").src = after;
  byId("ending-sum").textContent = summary(episode);
  byId("ending-why").textContent = why(episode);
  byId("ending-why").hidden = !byId("ending-why").textContent;
  drawClip(episode);
  byId("ending-next").hidden = !canGoOn(episode);
  byId("go-on-anyway").hidden = episode.outcome !== "refused";
  byId("more-pushes").hidden = episode.outcome === "refused";
}

function goOn(changes) {
  if (!canGoOn(shown)) return toast("Another table is on view; show that of this run first.", "warning");
  const goal = known("goals").find(({ id }) => id === shown.goal);
  if (!goal) return toast("The goal of this episode has been deleted; choose another one.", "warning");
  set("goal", goal);
  return startEpisode(changes);
}

export function setUpEnding() {
  const after = byId("ending-pair").querySelector(".over");
  const wipe = () => { after.style.clipPath = `inset(0 0 0 ${100 - byId("ending-at").value}%)`; };
  byId("ending-at").addEventListener("input", wipe);
  wipe();
  watch("scene", () => { if (shown) drawEnding(shown); });
  byId("more-pushes").addEventListener("click", () => goOn({ steps: MORE }));
  byId("go-on-anyway").addEventListener("click", () => goOn({ despite_doubts: true }));
  byId("another-photo").addEventListener("click", () => {
    showTab("episode");
    byId("goal-card").open = true;
    byId("goal-file").click();
  });
}
