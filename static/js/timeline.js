// A slider over the steps of an episode, and a player that moves it.
import { byId } from "./dom.js";

const ACTION_MS = 200;

export class Timeline {
  /** `onStep` is told the step that shall be seen. */
  constructor(onStep) {
    this.onStep = onStep;
    this.timer = 0;
    this.slider = byId("timeline");
    this.button = byId("timeline-play");
    this.slider.addEventListener("input", () => {
      this.pause();
      this.#tell();
    });
    this.button.addEventListener("click", () => (this.timer ? this.pause() : this.play()));
    this.speed = byId("timeline-speed");
    this.speed.addEventListener("change", () => { if (this.timer) this.#run(); });
  }

  get step() {
    return Number(this.slider.value);
  }

  get last() {
    return Number(this.slider.max);
  }

  /** Steps 0 to `last`, and where to be. */
  set(last, step) {
    this.slider.max = Math.max(last, 0);
    this.slider.value = step;
    this.slider.disabled = this.button.disabled = last < 1;
    this.#tell();
  }

  go(step) {
    this.pause();
    this.slider.value = step;
    this.#tell();
  }

  play() {
    if (this.step >= this.last) this.slider.value = 0;
    this.#run();
    this.#tell();
  }

  pause() {
    clearInterval(this.timer);
    this.#draw(0);
  }

  #run() {
    clearInterval(this.timer);
    this.#draw(setInterval(() => this.#next(), ACTION_MS / Number(this.speed.value)));
  }

  #next() {
    const isEnd = this.step >= this.last;
    if (isEnd && !byId("timeline-loop").checked) return this.pause();
    this.slider.value = isEnd ? 0 : this.step + 1;
    return this.#tell();
  }

  #draw(timer) {
    this.timer = timer;
    this.button.textContent = timer ? "❚❚" : "▶";
    this.button.setAttribute("aria-label", timer ? "Pause the pictures" : "Play the pictures");
  }

  #tell() {
    byId("timeline-step").textContent = `${this.step} / ${this.last}`;
    this.slider.setAttribute("aria-valuetext", `Step ${this.step} of ${this.last}`);
    this.onStep(this.step);
  }
}
