// Cutting the goal image out of a photo: the photo is moved, zoomed and turned under a frame that is what the goal
// camera would see, with the table as it is now over it, faint. All numbers are pixels of the photo as it was sent.
import { patch } from "./api.js";
import { byId } from "./dom.js";
import { mayDrive } from "./driver.js";
import { current, known, set, watch } from "./state.js";
import { scrollTo } from "./tabs.js";
import { act } from "./toasts.js";

const LEAST = 64; // of the side that may be cut out, if the photo has as many
const WHEEL = 0.0015;
const NUDGE = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
let goal = null; // whose photo is being cropped
let at = null; // {x, y, width, turn}: the middle of what is cut out, its side, and by how much it is turned [degrees]

const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(low, high));
const aspect = () => goal.height / goal.width;
const widest = () => Math.min(goal.photo.width, goal.photo.height / aspect());

function show(changes) {
  const { width: across, height: down } = goal.photo;
  at = { ...at, ...changes };
  at.width = clamp(at.width, Math.min(LEAST, widest()), widest());
  const [halfX, halfY] = [at.width / 2, (at.width * aspect()) / 2];
  at.x = clamp(at.x, halfX, across - halfX);
  at.y = clamp(at.y, halfY, down - halfY);
  const frame = byId("crop-frame");
  const scale = frame.clientWidth / at.width;
  const image = byId("crop-photo");
  image.style.width = `${across}px`;
  image.style.height = `${down}px`;
  image.style.transform = `translate(${frame.clientWidth / 2}px, ${frame.clientHeight / 2}px) rotate(${-at.turn}deg) scale(${scale}) translate(${-at.x}px, ${-at.y}px)`;
  byId("crop-zoom").value = (100 * Math.log(widest() / at.width)) / Math.log(widest() / Math.min(LEAST, widest()) || 2);
  byId("crop-turn").value = at.turn;
  const turned = at.turn ? `, turned by ${at.turn.toFixed(1).replace(/\.0$/, "")}°` : "";
  byId("crop-told").textContent = `${at.width.toFixed(0)} × ${(at.width * aspect()).toFixed(0)} of the photo's ${across} × ${down} px, `
    + `from ${(at.x - halfX).toFixed(0)} across and ${(at.y - halfY).toFixed(0)} down${turned}`;
}

/** Moves by pixels of the page. */
function pan(dx, dy) {
  const scale = at.width / byId("crop-frame").clientWidth;
  const angle = (at.turn * Math.PI) / 180;
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  show({ x: at.x - scale * (dx * cos - dy * sin), y: at.y - scale * (dx * sin + dy * cos) });
}

export function openCrop() {
  goal = known("goal");
  if (!goal?.photo || !mayDrive()) return;
  const { left, top, width, turn_deg: turn } = goal.photo.crop;
  byId("goal-card").open = true;
  byId("goal-choice").hidden = true;
  byId("cropping").hidden = false;
  byId("crop-frame").style.aspectRatio = `${goal.width} / ${goal.height}`;
  byId("crop-photo").src = `api/goals/${encodeURIComponent(goal.id)}/photo.jpg`;
  const scene = current();
  byId("crop-table").hidden = !scene;
  if (scene) byId("crop-table").src = `api/scenes/${scene.id}/images/goal.png?${new URLSearchParams({ revision: scene.revision, pusher: false })}`;
  show({ x: left + width / 2, y: top + (width * aspect()) / 2, width, turn });
  scrollTo(byId("goal-card"));
  byId("crop-frame").focus({ preventScroll: true });
}

function close() {
  goal = null;
  byId("cropping").hidden = true;
  byId("goal-choice").hidden = Boolean(known("draft"));
}

async function use() {
  const crop = { left: at.x - at.width / 2, top: at.y - (at.width * aspect()) / 2, width: at.width, turn_deg: at.turn };
  const cropped = await patch(`goals/${encodeURIComponent(goal.id)}`, { crop });
  close();
  set("goals", known("goals").map((other) => (other.id === cropped.id ? cropped : other)));
  set("goal", cropped);
}

function setUpDrag(frame) {
  const fingers = new Map(); // where each is
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 1;
  };
  frame.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    frame.setPointerCapture(event.pointerId);
  });
  frame.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last || !goal) return;
    const before = apart();
    fingers.set(event.pointerId, event);
    pan((event.clientX - last.clientX) / fingers.size, (event.clientY - last.clientY) / fingers.size);
    if (fingers.size === 2) show({ width: (at.width * before) / Math.max(apart(), 1) }); // pinched
  });
  for (const kind of ["pointerup", "pointercancel"]) frame.addEventListener(kind, ({ pointerId }) => fingers.delete(pointerId));
  frame.addEventListener("wheel", (event) => {
    event.preventDefault();
    show({ width: at.width * Math.exp(event.deltaY * WHEEL) });
  }, { passive: false });
  frame.addEventListener("keydown", (event) => {
    if (!(event.key in NUDGE)) return;
    event.preventDefault();
    event.stopPropagation(); // or they would push what is on the table
    const by = event.shiftKey ? 10 : 2;
    pan(...NUDGE[event.key].map((sign) => sign * by));
  });
}

export function setUpCrop() {
  setUpDrag(byId("crop-frame"));
  byId("crop-zoom").addEventListener("input", (event) => {
    const least = Math.min(LEAST, widest());
    show({ width: widest() * (least / widest()) ** (event.target.value / 100) });
  });
  byId("crop-turn").addEventListener("input", (event) => show({ turn: Number(event.target.value) }));
  byId("crop-faint").addEventListener("change", (event) => byId("crop-frame").classList.toggle("alone", !event.target.checked));
  byId("crop-use").addEventListener("click", () => act(byId("crop-use"), use));
  byId("crop-stop").addEventListener("click", close);
  byId("crop-goal").addEventListener("click", openCrop);
  watch("goal", (chosen) => {
    byId("crop-goal").hidden = !chosen?.photo;
    if (goal && goal.id !== chosen?.id) close();
  });
}
