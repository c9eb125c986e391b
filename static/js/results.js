// What can be taken away from an episode: a link to this moment, files.
import { byId, el } from "./dom.js";
import { LIVE } from "./jobs.js";
import { toast } from "./toasts.js";

const FILES = { "video.mp4": "Video", "clip.mp4": "Clip", "report.json": "Report", "steps.csv": "CSV", "episode.viser": "Recording", "goal.png": "Goal", "episode.zip": "All in one" };
let shown = null;
let stepOf = () => 0;

const fileUrl = (name) => `api/episodes/${encodeURIComponent(shown.id)}/files/${encodeURIComponent(name)}`;

async function copyLink() {
  const url = new URL(document.baseURI);
  url.search = new URLSearchParams({ episode: shown.id, step: stepOf() });
  try {
    await navigator.clipboard.writeText(url.href);
    toast("The link is in the clipboard.");
  } catch {
    // Browsers allow the clipboard on secure pages only; the address bar works everywhere.
    history.replaceState(null, "", url);
    toast("The link is in the address bar now.");
  }
}

/** Draws what there is to take. */
export function drawResults(episode) {
  shown = episode;
  const files = LIVE.has(episode.status) ? [] : episode.files;
  byId("shown-actions").hidden = episode.steps.length === 0;
  byId("downloads").replaceChildren(...files.map((name) =>
    el("a", { href: fileUrl(name), textContent: FILES[name] ?? name, download: `${episode.name}-${name}` })));
}

export function setUpResults(step) {
  stepOf = step;
  byId("copy-link").addEventListener("click", copyLink);
}
