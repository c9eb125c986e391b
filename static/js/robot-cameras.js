// What the robot's cameras see, while its tab is on view: small pictures, and how old each of them is.
import { get } from "./api.js";
import { LatestImage } from "./cameras.js";
import { byId, el } from "./dom.js";
import { known, set } from "./state.js";

const EVERY_MS = 2000;
const OLD_S = 10; // from then on it is said in colour
const HELD = ["looking", "driving"]; // the service has the robot not look besides, which could hold it up
const tiles = new Map();
let isAsking = false;

function age({ age_s: seconds }) {
  if (seconds === null) return "nothing yet";
  if (seconds < 2) return "now";
  if (seconds < 120) return `${Math.round(seconds)} s ago`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min ago` : `${Math.round(seconds / 3600)} h ago`;
}

function tile({ name, width, height }) {
  const image = el("img", { alt: `What the robot's camera ${name} saw last`, width, height });
  const href = `api/robot/cameras/${name.split("/").map(encodeURIComponent).join("/")}.jpg`;
  const words = el("span", {});
  const link = el("a", { href, target: "_blank", title: `Open the picture of camera ${name}` }, image);
  return { node: el("li", {}, link, words), words, href, latest: new LatestImage(image), shown: null };
}

function draw(cameras) {
  if (cameras.length !== tiles.size || cameras.some(({ name }) => !tiles.has(name))) {
    tiles.clear();
    for (const camera of cameras) tiles.set(camera.name, tile(camera));
    byId("robot-cameras").replaceChildren(...[...tiles.values()].map(({ node }) => node));
  }
  for (const camera of cameras) {
    const its = tiles.get(camera.name);
    its.words.textContent = `${camera.name}, ${age(camera)}`;
    its.words.className = camera.age_s > OLD_S ? "old" : "";
    const url = camera.seen_at && `${its.href}?v=${encodeURIComponent(camera.seen_at)}`;
    if (url && url !== its.shown) its.latest.show(url);
    its.shown = url;
  }
  set("robotPictures", Object.fromEntries([...tiles].map(([name, { shown }]) => [name, shown])));
}

async function refresh() {
  if (isAsking || byId("panel-robot").hidden || document.hidden || !known("robot")?.host) return;
  isAsking = true;
  byId("robot-cameras-note").textContent = HELD.includes(known("robot").state) ? "While the program looks or moves, these are its own looks." : "";
  try {
    draw(await get("robot/cameras"));
  } catch (error) {
    byId("robot-cameras-note").textContent = `${error.message} What is shown here is older than it says.`;
  }
  isAsking = false;
}

export function setUpRobotCameras() {
  new MutationObserver(refresh).observe(byId("panel-robot"), { attributeFilter: ["hidden"] });
  document.addEventListener("visibilitychange", refresh);
  setInterval(refresh, EVERY_MS);
}
