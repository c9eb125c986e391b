// The panel's tabs, and those within two of them, with arrow keys as the ARIA pattern wants them.
import { asked, note, onTravel } from "./address.js";
import { byId } from "./dom.js";

const tabsOf = (list) => [...list.querySelectorAll('[role="tab"]:not([hidden])')];
const panelOf = (tab) => byId(tab.getAttribute("aria-controls"));
/** What a tab puts on view: of the tabs within it the one that was chosen last, where there are any. */
const nameOf = (tab) => (panelOf(tab).querySelector('[role="tab"][aria-selected="true"]') ?? tab).id.slice(4);

/** Puts a part of the panel on view, as "photo", from its top. */
export function showTab(name) {
  choose(name);
  scrollTo(byId(`panel-${name}`));
}

function choose(name) {
  note({ tab: name });
  draw(name);
}

/** What is hidden is not on view; what was chosen within a tab stays so while another tab is on view. */
function draw(name) {
  for (const list of document.querySelectorAll('[role="tablist"]')) {
    const chosen = tabsOf(list).find((tab) => panelOf(tab).contains(byId(`panel-${name}`)));
    for (const tab of tabsOf(list)) {
      panelOf(tab).hidden = tab !== chosen;
      if (!chosen) continue;
      tab.setAttribute("aria-selected", String(tab === chosen));
      tab.tabIndex = tab === chosen ? 0 : -1;
    }
  }
}

/** The part of the address; another name than that of one that can be shown is none. */
function follow({ tab }) {
  if (byId(`panel-${tab}`) && !byId(`tab-${tab}`)?.hidden) draw(tab);
}

export function setUpTabs() {
  follow(asked());
  onTravel(follow);
  for (const tab of document.querySelectorAll('[role="tab"]')) { // some are shown later
    tab.addEventListener("click", () => choose(nameOf(tab)));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const all = tabsOf(tab.closest('[role="tablist"]'));
      const next = all[(all.indexOf(tab) + step + all.length) % all.length];
      choose(nameOf(next));
      next.focus();
    });
  }
}

/** Scrolls the panel so that a card of it begins at its top; the page itself stays where it is. */
export function scrollTo(card) {
  const panel = card.closest('.panel > [role="tabpanel"]');
  if (getComputedStyle(panel).overflowY === "visible") { // on narrow screens the page scrolls
    card.scrollIntoView({ block: "start" });
    return;
  }
  panel.scrollTop += card.getBoundingClientRect().top - panel.getBoundingClientRect().top;
}
