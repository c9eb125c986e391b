// The panel's tabs, with arrow keys as the ARIA pattern wants them.
import { asked, note, onTravel } from "./address.js";
import { byId } from "./dom.js";

const tabs = () => [...document.querySelectorAll('[role="tab"]:not([hidden])')];

export function showTab(name) {
  note({ tab: name });
  draw(name);
}

function draw(name) {
  for (const tab of tabs()) {
    const chosen = tab.id === `tab-${name}`;
    tab.setAttribute("aria-selected", String(chosen));
    tab.tabIndex = chosen ? 0 : -1;
    byId(tab.getAttribute("aria-controls")).hidden = !chosen;
  }
}

/** The tab of the address; another name than that of a tab is none. */
function follow({ tab }) {
  if (tabs().some(({ id }) => id === `tab-${tab}`)) draw(tab);
}

export function setUpTabs() {
  follow(asked());
  onTravel(follow);
  for (const tab of document.querySelectorAll('[role="tab"]')) { // some are shown later
    tab.addEventListener("click", () => showTab(tab.id.slice(4)));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const all = tabs();
      const next = all[(all.indexOf(tab) + step + all.length) % all.length];
      showTab(next.id.slice(4));
      next.focus();
    });
  }
}

/** Scrolls the panel so that a card of it begins at its top; the page itself stays where it is. */
export function scrollTo(card) {
  const panel = card.closest('[role="tabpanel"]');
  if (getComputedStyle(panel).overflowY === "visible") { // on narrow screens the page scrolls
    card.scrollIntoView({ block: "start" });
    return;
  }
  panel.scrollTop += card.getBoundingClientRect().top - panel.getBoundingClientRect().top;
}
