// What can be taken away from an episode: its film, a link to this moment, files.
import { ApiError, problemOf } from "./api.js";
import { byId, el, whileDisabled } from "./dom.js";
import { LIVE } from "./jobs.js";
import { tellFailure, toast } from "./toasts.js";

const VIDEO = "video.mp4";
const FILES = { [VIDEO]: "Video", "clip.mp4": "Clip", "report.json": "Report", "steps.csv": "CSV", "episode.viser": "Recording", "goal.png": "Goal", "episode.zip": "All in one" };
let shown = null;
let stepOf = () => 0;

const fileUrl = (name) => `api/episodes/${encodeURIComponent(shown.id)}/files/${encodeURIComponent(name)}`;

/** Waits until a file that is made on demand is there. */
async function prepared(url) {
  let answer;
  try {
    answer = await fetch(url);
  } catch {
    throw new ApiError("The service cannot be reached.", 0);
  }
  if (!answer.ok) throw new ApiError(await problemOf(answer), answer.status);
  await answer.body?.cancel();
}

function busily(button, action) {
  const text = button.textContent;
  return whileDisabled(button, async () => {
    button.textContent = "One moment";
    await tellFailure(action, button);
    button.textContent = text;
  });
}

async function watchVideo() {
  const url = fileUrl(VIDEO);
  await prepared(url);
  const video = byId("shown-video");
  video.hidden = false;
  video.src = url;
  video.play().catch(() => {}); // a browser that does not play by itself shows its own button
}

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

/** Draws what there is to take; `isOther` tells that another episode was on view before. */
export function drawResults(episode, isOther) {
  shown = episode;
  const files = LIVE.has(episode.status) ? [] : episode.files;
  const video = byId("shown-video");
  if (isOther) {
    video.hidden = true;
    video.removeAttribute("src");
    video.load();
  }
  byId("shown-actions").hidden = episode.steps.length === 0;
  byId("watch-video").hidden = !files.includes(VIDEO);
  byId("downloads").replaceChildren(...files.map((name) =>
    el("a", { href: fileUrl(name), textContent: FILES[name] ?? name, download: `${episode.name}-${name}` })));
}

export function setUpResults(step) {
  stepOf = step;
  byId("watch-video").addEventListener("click", () => busily(byId("watch-video"), watchVideo));
  byId("copy-link").addEventListener("click", copyLink);
}
