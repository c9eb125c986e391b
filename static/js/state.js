// What the page knows of the service; modules subscribe to what they show.

// The scene is undefined until the service has told, and null when there is none.
// `training` is the job that trains a field now, or the latest one that did; `estimate` and `episode` likewise,
// `objectWork` the one that fetches or makes objects, `clip` the one that makes a clip, `photoJob` the one
// that looks at a photo of a table, `photo` the one that is marked on this page, null if there is none.
// `camera` is the calibrated one that was saved on this page, null if there is none.
// `goal` is the one that was chosen on this page; `draft` the one that is being composed, null when there is none.
// `push` is the one that is tried by hand, null when there is none.
// `check` is what the service says of the goal and the table, null while it says nothing.
// `driver` tells which visitor drives; `opened` is an episode that somebody wants to see, `report`
// the one that was fetched last; `settings` what the form says, null if that cannot be used.
// `recorded` tells whether a recording is on view in place of the live table.
// `robot` is the robot of the service, whose host is null where it has none; `robotPictures` are addresses of what
// its cameras saw last, by name.
const state = {
  scene: undefined, objects: [], fields: undefined, training: undefined, estimate: undefined, episode: undefined,
  objectWork: undefined, clip: undefined, photoJob: undefined, photo: null,
  camera: null, goals: [], goal: null, check: null, draft: null, push: null, driver: null, opened: null, report: null, settings: null,
  recorded: false, robot: undefined, robotPictures: {},
};
const listeners = Object.fromEntries(Object.keys(state).map((what) => [what, []]));

export const current = () => state.scene;
export const objects = () => state.objects;
export const known = (what) => state[what];
export const labelOf = (name) => state.objects.find((object) => object.name === name)?.label ?? name;

const bare = /[\w.-]*\w/g; // a whole word, as names of objects are

/** A sentence of the service with what people call the objects in place of their names. */
export const inWords = (text) => text.replace(bare, (word) => (/[_\d]/.test(word) ? labelOf(word) : word));

/** Calls `listener` now and whenever the value changes. */
export function watch(what, listener) {
  listeners[what].push(listener);
  listener(state[what]);
}

/** A service that was started again may count revisions from further back: take whatever it says next. */
export function expectOlder() {
  if (state.scene) state.scene = { ...state.scene, revision: -1 };
  if (state.draft) state.draft = { ...state.draft, revision: -1 };
}

/** Whether a value was overtaken by a newer one that is known already. */
function isOvertaken(what, value) {
  const before = state[what];
  if (!value || !before) return false;
  if (what === "scene") return value.id === before.id && value.revision < before.revision;
  return what === "draft" && value.scene === before.scene && value.revision < before.revision;
}

export function set(what, value) {
  if (isOvertaken(what, value)) return;
  state[what] = value;
  for (const listener of listeners[what]) listener(value);
}
