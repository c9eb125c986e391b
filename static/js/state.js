// What the page knows of the service; modules subscribe to what they show.

// The scene is undefined until the service has told, and null when there is none.
// `training` is the job that trains a field now, or the latest one that did; `estimate` likewise.
const state = { scene: undefined, objects: [], training: undefined, estimate: undefined };
const listeners = { scene: [], objects: [], training: [], estimate: [] };

export const current = () => state.scene;
export const objects = () => state.objects;

/** Calls `listener` now and whenever the value changes. */
export function watch(what, listener) {
  listeners[what].push(listener);
  listener(state[what]);
}

/** A service that was started again may count revisions from further back: take whatever it says next. */
export function expectOlder() {
  if (state.scene) state.scene = { ...state.scene, revision: -1 };
}

export function set(what, value) {
  if (what === "scene" && value && state.scene && value.id === state.scene.id && value.revision < state.scene.revision) {
    return; // an answer that was overtaken by a newer event
  }
  state[what] = value;
  for (const listener of listeners[what]) listener(value);
}
