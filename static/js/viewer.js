// The 3D view in its frame: the live table, or a recording in its place until someone wants the live one back.
import { byId } from "./dom.js";
import { isDark } from "./theme.js";

let recording = null; // {url, text} while one is shown

/** Loads the frame again with what it should show; also after the service was lost, or the theme has changed. */
export function showViewer() {
  const frame = byId("viewer");
  const query = recording ? `&${new URLSearchParams({ playbackPath: recording.url })}` : "";
  frame.src = `viewer/?hideViserLogo${isDark() ? "&darkMode" : ""}${query}`;
  frame.hidden = false;
  byId("viewer-wait").hidden = true;
  byId("replaying").hidden = !recording;
  byId("replaying-text").textContent = recording?.text ?? "";
}

export const isViewerShown = () => !byId("viewer").hidden;

/** Plays a recording, whose address must be absolute. */
export function replay(url, text) {
  recording = { url, text };
  showViewer();
}

export function setUpViewer() {
  byId("back-to-live").addEventListener("click", () => {
    recording = null;
    showViewer();
  });
}
