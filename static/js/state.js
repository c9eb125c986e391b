// What the page knows of the service; modules subscribe to what they show.

const state = { scene: null, objects: [] };
const listeners = { scene: [], objects: [] };

export const current = () => state.scene;
export const objects = () => state.objects;

/** Calls `listener` now and whenever the value changes. */
export function watch(what, listener) {
  listeners[what].push(listener);
  listener(state[what]);
}

export function set(what, value) {
  if (what === "scene" && value && state.scene && value.id === state.scene.id && value.revision < state.scene.revision) {
    return; // an answer that was overtaken by a newer event
  }
  state[what] = value;
  for (const listener of listeners[what]) listener(value);
}
