// What is on view, in the page's address: the tab, an episode and its step; Back and Forward go through them.

const DEFAULTS = { tab: "episode" };
const listeners = [];

const read = () => Object.fromEntries(new URLSearchParams(location.search));

/** What the address asks for: { tab, episode, step }, each a text or undefined. */
export const asked = () => ({ ...DEFAULTS, ...read() });

/** Notes what is on view now; null takes something out. Another tab or episode is a step that Back undoes, a step is not. */
export function note(changes) {
  const before = asked();
  const now = { ...read(), ...changes };
  for (const [key, value] of Object.entries(now)) if (value === null || value === undefined || value === DEFAULTS[key]) delete now[key];
  const query = new URLSearchParams(now).toString();
  if (query === location.search.slice(1)) return;
  const isAnother = ["tab", "episode"].some((key) => ({ ...DEFAULTS, ...now })[key] !== before[key]);
  history[isAnother ? "pushState" : "replaceState"](null, "", `${location.pathname}${query && `?${query}`}`);
}

/** Calls `listener` with what the address asks for whenever somebody goes back or forward. */
export function onTravel(listener) {
  listeners.push(listener);
}

export function setUpAddress() {
  window.addEventListener("popstate", () => { for (const listener of listeners) listener(asked()); });
}
