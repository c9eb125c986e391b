// Puts the page together: sets the pieces up, follows the event stream, keeps the status line honest.
import { setUpAddress } from "./address.js";
import { VISITOR, allAnswered, get } from "./api.js";
import { setUpBeside } from "./beside.js";
import { setUpCalibrate } from "./calibrate.js";
import { setUpCameras, showFrames } from "./cameras.js";
import { setUpClip } from "./clip.js";
import { setUpCompose } from "./compose.js";
import { setUpCrop } from "./crop.js";
import { refreshDamaged } from "./damaged.js";
import { byId } from "./dom.js";
import { setUpDriver } from "./driver.js";
import { setUpDrop } from "./drop.js";
import { setUpEnding } from "./ending.js";
import { setUpEpisode } from "./episode.js";
import { refreshSettings, setUpEpisodeSettings } from "./episode-settings.js";
import { refreshShown, setUpEpisodeView, shownStep } from "./episode-view.js";
import { dropEpisode, refreshEpisodes, setUpEpisodes } from "./episodes.js";
import { setUpEstimate } from "./estimate.js";
import { listen } from "./events.js";
import { refreshSets, setUpFields } from "./fields.js";
import { setUpGoalCheck } from "./goal-check.js";
import { refreshGoals, setUpGoals } from "./goals.js";
import { dropJob, refreshJobs, setUpJobs, showJob } from "./jobs.js";
import { setUpFool } from "./fool.js";
import { setUpKeyboard } from "./keyboard.js";
import { setUpLight } from "./light.js";
import { setUpLooks, showLook } from "./looks.js";
import { setUpNeural } from "./neural.js";
import { setUpNumbers } from "./numbers.js";
import { setUpObjectWork } from "./object-work.js";
import { refreshObjects, setUpObjects } from "./objects.js";
import { setUpOwnObject } from "./own-object.js";
import { refreshPhotos, setUpPhoto } from "./photo.js";
import { setUpPicture } from "./picture.js";
import { setUpPredictedPush } from "./predicted-push.js";
import { setUpPresets } from "./presets.js";
import { setUpPush } from "./push.js";
import { setUpResults } from "./results.js";
import { hearRobot, hearStream, setUpRobot } from "./robot.js";
import { refreshScenes, setUpScenes } from "./scenes.js";
import { expectOlder, set } from "./state.js";
import { setUpStory } from "./story.js";
import { setUpTabs } from "./tabs.js";
import { setUpTheme } from "./theme.js";
import { setUpToasts, settleUnreachable, toast } from "./toasts.js";
import { isViewerShown, setUpViewer, showViewer } from "./viewer.js";
import { setUpWelcome } from "./welcome.js";

const STARTING = { starting: "Simulation starting", restarting: "Simulation restarting" };

function status(text, state) {
  byId("status").textContent = text;
  byId("status").dataset.state = state;
}

const STARTING_INTERVAL_MS = 300;
const HEALTH_INTERVAL_MS = 15_000;
let follower = 0;
let isViewerOld = false;

/** Shows the 3D view once the simulation is ready, and what is wrong. A later call takes over from an earlier one. */
async function followHealth(again) {
  follower += 1;
  isViewerOld ||= again;
  for (const me = follower; me === follower; ) {
    let pause = STARTING_INTERVAL_MS;
    try {
      const health = await get("health");
      const isReady = health.stage === "ready";
      if (!isReady) status(STARTING[health.stage] ?? "Starting", "wait");
      else if (health.status === "ok") status("Connected", "live");
      else status(health.problems[0], "wait");
      if (isReady && (isViewerOld || !isViewerShown())) showViewer();
      isViewerOld &&= !isReady;
      pause = isReady ? HEALTH_INTERVAL_MS : STARTING_INTERVAL_MS;
    } catch {
      status("Reconnecting", "lost");
      return; // the event stream tells when the service is back
    }
    await new Promise((resolve) => setTimeout(resolve, pause));
  }
}

setUpAddress();
setUpTheme();
setUpTabs();
setUpToasts();
setUpViewer();
setUpDriver();
setUpCameras();
setUpNeural();
setUpLooks();
setUpFool();
setUpPush();
setUpPredictedPush();
setUpLight();
setUpNumbers();
setUpScenes();
setUpObjects();
setUpOwnObject();
setUpObjectWork();
setUpJobs();
setUpFields();
setUpEstimate();
setUpPresets();
setUpGoals();
setUpCrop();
setUpGoalCheck();
setUpPhoto();
setUpPicture();
setUpCalibrate();
setUpCompose();
setUpDrop();
setUpEpisodeView();
setUpResults(shownStep);
setUpEnding();
setUpBeside();
setUpClip();
setUpEpisodeSettings();
setUpEpisode();
setUpEpisodes();
setUpWelcome();
setUpRobot();
setUpStory();
setUpKeyboard();
refreshObjects();
refreshSets();
refreshGoals();
refreshPhotos();
refreshDamaged();

const showPanel = () => byId("panel").classList.remove("unknown");

/** The panel comes when it is known what belongs there, so that nothing moves under the pointer; or with a first click. */
const showKnownPanel = () => byId("panel").classList.contains("unknown") && allAnswered().then(showPanel);
document.addEventListener("click", showPanel, { capture: true, once: true });

listen(VISITOR, {
  open(again) {
    settleUnreachable();
    followHealth(again);
    refreshJobs();
    hearStream(true);
    if (again) {
      expectOlder();
      set("draft", null); // told again if there still is one
      set("push", null);
      refreshScenes();
      refreshObjects();
      refreshSets();
      refreshGoals();
      refreshPhotos();
      refreshDamaged();
      refreshSettings();
      refreshEpisodes();
      refreshShown();
    }
  },
  lost() {
    showKnownPanel();
    status("Reconnecting", "lost");
    hearStream(false);
  },
  scene(scene) {
    set("scene", scene);
    showKnownPanel();
  },
  frame: showFrames,
  job(job) {
    showJob(job);
    hearRobot(job);
  },
  look: showLook,
  forgotten({ job }) {
    dropJob(job);
    dropEpisode(job);
  },
  draft: (draft) => set("draft", draft),
  push: (push) => set("push", push),
  goals: () => refreshGoals(),
  photos: () => refreshPhotos(),
  driver: (driver) => set("driver", driver),
  notice({ level, text }) {
    toast(text, level);
    followHealth(false); // it may be that the simulation is being restarted
  },
});
