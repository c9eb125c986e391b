// The light: two sliders and a dial that shows it from above, the rim being the horizon.
import { patch } from "./api.js";
import { byId } from "./dom.js";
import { current, set, watch } from "./state.js";
import { toast } from "./toasts.js";

const RADIUS = 100;
const MIN_DEG = 5;
const rad = (degrees) => (degrees * Math.PI) / 180;
const deg = (radians) => (radians * 180) / Math.PI;
let isBusy = false;
let wanted = null;
let isDragging = false;

function angles(position) {
  const [x, y, z] = position;
  return [(deg(Math.atan2(y, x)) + 360) % 360, deg(Math.asin(Math.min(Math.max(z, -1), 1)))];
}

function draw(azimuth, elevation) {
  const r = RADIUS * (1 - elevation / 90);
  const [x, y] = [r * Math.cos(rad(azimuth)), -r * Math.sin(rad(azimuth))];
  byId("dial-light").setAttribute("transform", `translate(${x} ${y})`);
  byId("dial-ray").setAttribute("x2", x);
  byId("dial-ray").setAttribute("y2", y);
  byId("light-angles").textContent = `azimuth ${azimuth.toFixed(0)}°, elevation ${elevation.toFixed(0)}°`;
}

/** Sends the newest light, one request at a time. */
async function send() {
  if (isBusy) return;
  isBusy = true;
  try {
    while (wanted && current()) {
      const [azimuth, elevation] = wanted;
      wanted = null;
      const flat = Math.cos(rad(elevation));
      const position = [flat * Math.cos(rad(azimuth)), flat * Math.sin(rad(azimuth)), Math.sin(rad(elevation))];
      set("scene", await patch(`scenes/${current().id}`, { light: { position } }));
    }
  } catch (error) {
    toast(error.message, "error");
  } finally {
    isBusy = false;
  }
}

function ask(azimuth, elevation) {
  byId("azimuth").value = azimuth;
  byId("elevation").value = elevation;
  draw(azimuth, elevation);
  wanted = [azimuth, elevation];
  send();
}

function fromPointer(event) {
  const box = byId("dial").getBoundingClientRect();
  const x = ((event.clientX - box.left) / box.width) * 220 - 110;
  const y = ((event.clientY - box.top) / box.height) * 220 - 110;
  const elevation = 90 * (1 - Math.hypot(x, y) / RADIUS);
  ask((deg(Math.atan2(-y, x)) + 360) % 360, Math.min(Math.max(elevation, MIN_DEG), 90));
}

export function setUpLight() {
  for (const slider of [byId("azimuth"), byId("elevation")]) {
    slider.addEventListener("input", () => ask(Number(byId("azimuth").value), Number(byId("elevation").value)));
  }
  const dial = byId("dial");
  dial.addEventListener("pointerdown", (event) => {
    dial.setPointerCapture(event.pointerId);
    isDragging = true;
    fromPointer(event);
  });
  dial.addEventListener("pointermove", (event) => { if (isDragging) fromPointer(event); });
  for (const end of ["pointerup", "pointercancel"]) dial.addEventListener(end, () => { isDragging = false; });
  watch("scene", (scene) => {
    if (!scene || isBusy || isDragging) return; // what the person does now counts more than what comes back
    const [azimuth, elevation] = angles(scene.light.position);
    byId("azimuth").value = azimuth;
    byId("elevation").value = elevation;
    draw(azimuth, elevation);
  });
}
