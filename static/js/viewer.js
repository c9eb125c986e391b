// The 3D view in its frame: loaded once the simulation is ready, loaded again after the service was lost.
import { byId } from "./dom.js";
import { isDark } from "./theme.js";

export function showViewer() {
  const frame = byId("viewer");
  frame.src = `viewer/?hideViserLogo${isDark() ? "&darkMode" : ""}`;
  frame.hidden = false;
  byId("viewer-wait").hidden = true;
}

export const isViewerShown = () => !byId("viewer").hidden;
