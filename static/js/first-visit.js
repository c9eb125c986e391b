// Runs before the page is drawn for the first time: where a story will play there is room for it, so that nothing moves.
// Whoever has seen it in this tab, or follows a link to an episode, finds the cameras there.
(() => {
  if (sessionStorage.getItem("osf-story-seen") || new URLSearchParams(location.search).has("episode")) return;
  document.getElementById("story-foot").hidden = document.getElementById("timeline-bar").hidden = false;
  document.getElementById("cameras").hidden = true;
})();
