// What to do where there is nothing on the table yet.
import { byId, whileDisabled } from "./dom.js";
import { fetchObjects } from "./objects.js";
import { anotherScene } from "./scenes.js";
import { current, objects, watch } from "./state.js";

const hasObjects = () => objects().some((object) => object.available);

function draw() {
  byId("welcome").hidden = current() !== null || !objects().length;
  byId("welcome-title").textContent = hasObjects() ? "The table is empty" : "No objects yet";
  byId("welcome-text").textContent = hasObjects()
    ? "Choose an example under Try it, or make a scene: some objects at rest in random places under a random light."
    : "The scanned objects are fetched once, about 90 MB, and kept on this machine. A first scene follows by itself.";
  byId("welcome-button").textContent = hasObjects() ? "Make a scene" : "Fetch objects";
}

export function setUpWelcome() {
  const button = byId("welcome-button");
  button.addEventListener("click", () => (hasObjects() ? whileDisabled(button, () => anotherScene(button)) : fetchObjects(button)));
  watch("scene", draw);
  watch("objects", draw);
}
