// How an episode ended: goal, before and after, what it came to in one line, what is missing, and what to do about it.
import { drawClip } from "./clip.js";
import { byId } from "./dom.js";
import { startEpisode } from "./episode.js";
import { reached } from "./episode-settings.js";
import { LIVE } from "./jobs.js";
import { NOT_KNOWN, length, offsets, summary } from "./run-summary.js";
import { current, known, labelOf, set, watch } from "./state.js";
import { showTab } from "./tabs.js";
import { toast } from "./toasts.js";

const MORE = 20;
let shown = null;

/** What is not as it should be, for each object. */
function missing({ objects, steps }) {
  const last = steps.at(-1);
  const near = reached() ?? { mm: 0, deg: 0 };
  return objects.flatMap((name) => {
    const far = offsets(last)?.[name] ?? 0; // what is not known is not told as missing
    const turned = last.to_goal_deg?.[name] ?? 0;
    const parts = [far > near.mm && `${length(far)} away`, turned > near.deg && `turned by ${turned.toFixed(turned < 10 ? 1 : 0)}°`].filter(Boolean);
    if (!parts.length) return [];
    return [`${labelOf(name)} is still ${parts.join(" and ")}`];
  });
}

function why(episode) {
  if (episode.outcome === "refused") return "Nothing was moved, since the goal image is doubtful.";
  if (episode.outcome === "reached") return "";
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
  const frame = (round, part) => `api/episodes/${encodeURIComponent(episode.id)}/frames/${round}.png?part=${part}`;
  const last = episode.steps.length - 1;
  for (const [id, url] of [["goal", frame(last, "goal")], ["before", frame(0, "now")], ["after", frame(last, "now")]]) {
    const image = byId(`ending-${id}`);
    if (image.getAttribute("src") === url) continue;
    image.removeAttribute("src"); // else the picture of another episode stays until this one is there
    image.src = url;
  }
  byId("ending-sum").textContent = summary(episode);
  byId("ending-why").textContent = why(episode);
  byId("ending-why").hidden = !byId("ending-why").textContent;
  const rule = reached();
  byId("ending-rule").hidden = !rule || !offsets(episode.steps.at(-1));
  if (rule) byId("ending-rule").textContent = `Reached means: each object within ${rule.mm.toFixed(0)} mm and ${rule.deg.toFixed(1)}° of its goal, as the cameras see it.`;
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
  for (const what of ["scene", "objects"]) watch(what, () => { if (shown) drawEnding(shown); });
  byId("more-pushes").addEventListener("click", () => goOn({ steps: MORE }));
  byId("go-on-anyway").addEventListener("click", () => goOn({ despite_doubts: true }));
  byId("another-photo").addEventListener("click", () => {
    showTab("episode");
    byId("goal-card").open = true;
    byId("goal-file").click();
  });
}
