// The scene in numbers, and as a file for the command line.
import { byId, el } from "./dom.js";
import { current, watch } from "./state.js";
import { toast } from "./toasts.js";

const SIMULATORS = { pybullet: "PyBullet", mujoco: "MuJoCo" };

const cm = (metres) => (100 * metres).toFixed(1);

function row(object) {
  const [x, y, z] = object.position;
  const turn = `quaternion (w, x, y, z): ${object.quaternion.map((q) => q.toFixed(3)).join(", ")}`;
  return el(
    "tr",
    { title: turn },
    el("td", { textContent: object.label }),
    ...[x, y, z].map((value) => el("td", { textContent: cm(value) })),
  );
}

/** The scene in the scene.json format. */
function sceneFile(scene) {
  const { objects, light, pusher, cameras } = scene;
  const file = { objects: objects.map(({ name, position, quaternion }) => ({ name, position, quaternion })), light, cameras };
  return JSON.stringify(pusher ? { ...file, pusher } : file, null, 1);
}

async function copy() {
  const text = sceneFile(current());
  try {
    await navigator.clipboard.writeText(text);
    toast("scene.json is in the clipboard.");
  } catch {
    // Browsers allow the clipboard on secure pages only; a download works everywhere.
    const link = el("a", { href: URL.createObjectURL(new Blob([text], { type: "application/json" })), download: "scene.json" });
    link.click();
    URL.revokeObjectURL(link.href);
  }
}

export function setUpNumbers() {
  byId("copy-scene").addEventListener("click", copy);
  watch("scene", (scene) => {
    byId("drive").hidden = !scene;
    if (!scene) return;
    byId("poses").replaceChildren(...scene.objects.map(row));
    const at = scene.pusher?.position;
    byId("pusher-position").textContent = at ? `at ${cm(at[0])}, ${cm(at[1])} cm` : "parked";
    byId("scene-facts").textContent = `Seed ${scene.seed}, ${scene.time_s.toFixed(1)} s of simulated time by ${SIMULATORS[scene.simulator]}.`;
  });
}
