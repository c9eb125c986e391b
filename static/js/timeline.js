// A slider over the rounds of an episode, and a player that moves it: at the pace of the replay, in which pushes are
// as fast as they were and looks are short.
import { byId } from "./dom.js";

const TICK_MS = 50;
const STEP_S = 0.6; // for episodes of earlier versions, which do not tell when a step is over

export class Timeline {
  /** `onStep` is told the step that shall be seen; `onMove` the moment, and whether and how fast it goes on from there. */
  constructor(onStep, onMove = () => {}) {
    this.onStep = onStep;
    this.onMove = onMove;
    this.timer = 0;
    this.times = [0];
    this.actions = [0];
    this.slider = byId("timeline");
    this.button = byId("timeline-play");
    this.slider.addEventListener("input", () => this.go(this.step));
    this.button.addEventListener("click", () => (this.timer ? this.pause() : this.play()));
    this.chosen = byId("timeline-speed");
    this.chosen.addEventListener("change", () => { if (this.timer) this.#run(this.#now()); });
  }

  get step() {
    return Number(this.slider.value);
  }

  get last() {
    return Number(this.slider.max);
  }

  get speed() {
    return Number(this.chosen.value);
  }

  /** When a step is over [s]. */
  at(step) {
    return this.times[Math.min(Math.max(step, 0), this.times.length - 1)] ?? 0;
  }

  /** Rounds 0 to `last`, where to be, when each is over [s], and after how many actions. */
  set(last, step, times = [], actions = []) {
    this.actions = actions;
    this.times = times.length > last ? times : Array.from({ length: Math.max(last, 0) + 1 }, (_, i) => STEP_S * i);
    this.slider.max = Math.max(last, 0);
    this.slider.disabled = this.button.disabled = last < 1;
    if (this.timer) return this.#tell(Math.min(this.step, last));
    return this.#tell(step);
  }

  go(step) {
    this.pause();
    this.#tell(step);
    this.onMove({ at_s: this.at(this.step), plays: false, speed: this.speed });
  }

  play() {
    this.#run(this.step >= this.last ? 0 : this.at(this.step));
  }

  pause() {
    if (this.timer) this.onMove({ at_s: this.#now(), plays: false, speed: this.speed });
    clearInterval(this.timer);
    this.#draw(0);
  }

  #run(from) {
    clearInterval(this.timer);
    this.from = from;
    this.rate = this.speed;
    this.since = performance.now();
    this.#draw(setInterval(() => this.#tick(), TICK_MS));
    this.onMove({ at_s: from, plays: true, speed: this.rate });
    this.#tick();
  }

  #now() {
    return this.from + (this.rate * (performance.now() - this.since)) / 1000;
  }

  #tick() {
    const now = this.#now();
    const next = this.times.findIndex((time) => time > now);
    const step = Math.min(next < 0 ? this.last : Math.max(next - 1, 0), this.last);
    if (step !== this.step) this.#tell(step);
    if (now < this.at(this.last)) return undefined;
    return byId("timeline-loop").checked ? this.#run(0) : this.pause();
  }

  #draw(timer) {
    this.timer = timer;
    this.button.textContent = timer ? "❚❚" : "▶";
    this.button.setAttribute("aria-label", timer ? "Pause the episode" : "Play the episode");
  }

  #tell(step) {
    this.slider.value = step;
    const [now, all] = [this.step, this.last].map((round) => this.actions[round] ?? round);
    byId("timeline-step").textContent = `${now} / ${all}`;
    this.slider.setAttribute("aria-valuetext", `Step ${now} of ${all}`);
    this.onStep(this.step);
  }
}
