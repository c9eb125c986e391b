// A clip of an episode that is over: making it, playing it, taking it along.
import { post } from "./api.js";
import { byId } from "./dom.js";
import { LIVE, stateText } from "./jobs.js";
import { inWords, known, set, watch } from "./state.js";
import { act } from "./toasts.js";

const FILE = "clip.mp4";
let shown = null; // the episode whose ending is on view

const mine = () => (known("clip")?.params.episode === shown?.id ? known("clip") : null);

/** Shows what there is of the clip of an episode. */
export function drawClip(episode = shown) {
  shown = episode;
  if (!shown) return;
  const job = mine();
  const isLive = LIVE.has(job?.state);
  const isThere = !isLive && (job?.state === "done" || shown.files.includes(FILE));
  const url = `api/episodes/${encodeURIComponent(shown.id)}/files/${FILE}`;
  byId("make-clip").hidden = isLive || isThere || shown?.settings.method === "paper"; // it shows distances to the goal
  byId("save-clip").hidden = byId("clip").hidden = !isThere;
  if (isThere && byId("clip").getAttribute("src") !== url) {
    byId("clip").src = url;
    byId("save-clip").href = url;
  }
  if (!isThere) byId("clip").removeAttribute("src");
  byId("clip-state").textContent = isLive ? stateText(job) : job?.state === "failed" ? inWords(job.error) : "";
}

export function setUpClip() {
  byId("make-clip").addEventListener("click", () => act(byId("make-clip"), async () =>
    set("clip", await post(`episodes/${encodeURIComponent(shown.id)}/clip`))));
  watch("clip", () => drawClip());
}
