// Dark or light: the system's choice until the person makes one.
import { redrawCharts } from "./charts.js";
import { byId } from "./dom.js";

const system = matchMedia("(prefers-color-scheme: dark)");
const KEY = "osf-theme";

export const isDark = () => document.documentElement.dataset.theme === "dark";

function apply() {
  const dark = (localStorage.getItem(KEY) ?? (system.matches ? "dark" : "light")) === "dark";
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  byId("theme-button").textContent = dark ? "Light" : "Dark";
  redrawCharts();
}

export function setUpTheme() {
  apply();
  system.addEventListener("change", apply);
  byId("theme-button").addEventListener("click", () => {
    localStorage.setItem(KEY, isDark() ? "light" : "dark");
    apply();
  });
}
