// All episodes, newest first, and links to a moment of one: ?episode=ID&step=N.
import { asked } from "./address.js";
import { get, patch, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { doubted } from "./doubt.js";
import { forDrivers } from "./driver.js";
import { dropShown, openEpisode, outcomeOf, showEpisode } from "./episode-view.js";
import { LIVE } from "./jobs.js";
import { pushes, took } from "./run-summary.js";
import { labelOf, watch } from "./state.js";
import { act, tellFailure, toast } from "./toasts.js";

const FEW = 6;
const PAGE = 50;
const MOST = 500; // that the service tells at once
const ARCHIVE = "episode.zip";
let all = []; // those that were fetched
let total = 0;
let older = null; // where the others begin
let showsAll = false;
let listed = ""; // the latest job's state when the list was fetched

function tookText(episode) {
  if (LIVE.has(episode.status)) return "";
  return `, ${[pushes(episode), took(episode)].filter(Boolean).join(" in ")}`;
}

/** The table before and after; of a few kilobytes each, and only once they come into view. */
function thumbnails(episode) {
  if (LIVE.has(episode.status) || !episode.files.includes(ARCHIVE)) return el("span", { className: "thumbnails" }); // it saw nothing
  const picture = (at, what) => {
    const image = el("img", { src: `api/episodes/${encodeURIComponent(episode.id)}/thumbnail.png?at=${at}`, alt: what, width: 56, height: 56, loading: "lazy" });
    image.addEventListener("error", () => image.remove());
    return image;
  };
  return el("span", { className: "thumbnails" }, picture("start", "Before"), picture("end", "After"));
}

/** A field comes in place of the name; Enter keeps what it says, Escape does not. */
function renameButton(episode, item) {
  return el("button", { type: "button", className: "plain", textContent: "Rename", on: { click: () => {
    const field = el("input", { type: "text", value: episode.name, maxLength: 100, attributes: { "aria-label": "Name of the episode" } });
    let isOver = false;
    const finish = async (keeps) => {
      if (isOver) return;
      isOver = true;
      const name = field.value.trim();
      if (keeps && name && name !== episode.name) await tellFailure(() => patch(`episodes/${encodeURIComponent(episode.id)}`, { name }));
      await refreshEpisodes();
    };
    field.addEventListener("keydown", ({ key }) => { if (key === "Enter" || key === "Escape") finish(key === "Enter"); });
    field.addEventListener("blur", () => finish(true));
    item.querySelector(".title").replaceWith(field);
    field.select();
  } } });
}

function entry(episode) {
  const { text, state } = outcomeOf(episode);
  const made = new Date(episode.created_at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const badge = el("span", { className: "badge", textContent: text });
  badge.dataset.state = state;
  const item = el("li", { className: "episode-entry" });
  const buttons = [
    el("button", { type: "button", className: "plain", textContent: "Show", on: { click: () => openEpisode(episode.id) } }),
    ...(LIVE.has(episode.status) ? [] : [
      forDrivers(renameButton(episode, item)),
      episode.files.includes(ARCHIVE) ? el("a", { href: `api/episodes/${encodeURIComponent(episode.id)}/files/${ARCHIVE}`, textContent: "Download", download: `${episode.name}.zip` }) : null,
      forDrivers(deleteButton(episode)),
    ]),
  ];
  item.append(
    thumbnails(episode),
    el("div", {},
      el("div", { className: "row" }, el("span", { className: "title", textContent: episode.name, title: episode.name }), badge),
      el("span", { className: "hint", textContent: `${made}${tookText(episode)}`, title: episode.objects.map(labelOf).join(", ") }),
      el("span", { className: "row entry-buttons" }, ...buttons)),
  );
  item.dataset.episode = episode.id;
  return item;
}

function deleteButton({ id }) {
  return doubted(el("button", { type: "button", className: "plain danger", textContent: "Delete" }), "Really delete", async () => {
    await remove(`episodes/${encodeURIComponent(id)}?forget=true`);
    await dropEpisode(id);
  });
}

/** Forgets an episode that was removed for good. */
export async function dropEpisode(id) {
  dropShown(id);
  if (all.some((episode) => episode.id === id)) await refreshEpisodes();
}

const wanted = () => {
  const search = byId("episode-search").value.trim();
  const outcome = byId("episode-outcome").value;
  return { ...(search && { search }), ...(outcome && { outcome }) };
};

function draw() {
  if (byId("episode-list").contains(document.activeElement) && document.activeElement.matches("input")) return; // a name is being written
  byId("no-episodes").hidden = all.length > 0;
  byId("no-episodes").textContent = Object.keys(wanted()).length ? "None like this." : "None yet. The first one begins with Start.";
  byId("episode-find").hidden = total <= FEW && !Object.keys(wanted()).length;
  byId("episode-list").replaceChildren(...(showsAll ? all : all.slice(0, FEW)).map(entry));
  const button = byId("all-episodes");
  button.hidden = total <= FEW;
  button.textContent = showsAll ? "Fewer" : `All ${total}`;
  byId("more-episodes").hidden = !showsAll || older === null;
}

function take(answer, before) {
  all = [...before, ...answer.episodes];
  ({ total, next: older } = answer);
  draw();
}

export async function refreshEpisodes() {
  const limit = Math.min(Math.max(all.length, PAGE), MOST);
  const query = new URLSearchParams({ limit, ...wanted() });
  const answer = await tellFailure(() => get(`episodes?${query}`));
  const isOvertaken = query.toString() !== new URLSearchParams({ limit, ...wanted() }).toString();
  if (answer && !isOvertaken) take(answer, []);
}

async function showOlder() {
  take(await get(`episodes?${new URLSearchParams({ limit: PAGE, after: older, ...wanted() })}`), all);
}

/** Opens what the page's address asks for. */
async function openLink() {
  const { episode: id, step: text } = asked();
  if (!id) return;
  const step = text === undefined ? undefined : Number(text);
  try {
    showEpisode(await get(`episodes/${encodeURIComponent(id)}`), Number.isInteger(step) && step >= 0 ? step : undefined);
  } catch (error) {
    toast(error.status === 404 ? "The episode of this link is not here; it may be on another machine." : error.message, "error");
  }
}

export function setUpEpisodes() {
  byId("all-episodes").addEventListener("click", () => {
    showsAll = !showsAll;
    draw();
  });
  const more = byId("more-episodes");
  more.addEventListener("click", () => act(more, showOlder));
  byId("episode-search").addEventListener("input", () => refreshEpisodes());
  byId("episode-outcome").addEventListener("change", () => refreshEpisodes());
  watch("objects", draw);
  watch("episode", (job) => {
    const now = job ? `${job.id} ${job.state}` : "";
    if (now !== listed) refreshEpisodes();
    listed = now;
  });
  refreshEpisodes();
  openLink();
}
