// The one player of the page: a slider over the seconds of what is on view, and what moves it at the pace of the replay,
// in which pushes are as fast as they were and looks are short. The 3D view shows its moment, or the table as it is now.
import { byId } from "./dom.js";
import { isDriving } from "./driver.js";
import { watch } from "./state.js";
import { replay, showLive } from "./viewer.js";

const TICK_MS = 50;
const NEAR_S = 1e-3; // a slider rounds
const WAYS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };

/**
 * A source, what can be on view, has
 *   of: { story } or { episode }, by which the service knows it; name: for people
 *   times: when each of its steps is over [s]; actions: how many there were then
 *   isRunning: whether it goes on, so that its end is the table as it is now
 *   speed: with which it begins, 1 if not given
 *   draw(index): told the step to be seen; ended(): that it was played to its end
 *   left(): that another source takes its place, not one of the same kind
 */
class Timeline {
  constructor() {
    this.source = null;
    this.at = 0; // [s]
    this.isLive = true; // whether the table as it is now is on view
    this.timer = 0;
    this.slider = byId("timeline");
    this.chosen = byId("timeline-speed");
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
    this.slider.addEventListener("keydown", (event) => this.#step(event));
    byId("timeline-play").addEventListener("click", () => this.toggle());
    byId("back-to-live").addEventListener("click", () => this.live());
    this.chosen.addEventListener("change", () => { if (this.isPlaying) this.#run(this.#now()); });
    this.#watchTable();
  }

  get times() {
    return this.source?.times ?? [];
  }

  get end() {
    return this.times.at(-1) ?? 0;
  }

  /** The step that is on view, 0 before the first one is over. */
  get index() {
    return Math.max(this.times.findLastIndex((time) => time <= this.at + NEAR_S), 0);
  }

  get isPlaying() {
    return this.timer !== 0;
  }

  /** Puts a source on view at a moment [s]; without one where one is, else at its end. */
  show(source, at) {
    if (this.source && this.source.left !== source.left) this.source.left();
    const isOther = JSON.stringify(this.source?.of) !== JSON.stringify(source.of);
    this.source = source;
    if (isOther) {
      this.#stop();
      this.chosen.value = source.speed ?? 1;
      this.isLive = source.isRunning || !this.times.length;
      this.at = this.end;
    }
    if (at !== undefined) return this.go(at);
    if (this.isLive) this.at = this.end;
    if (isOther) this.#show3D();
    return this.#draw();
  }

  go(at) {
    this.#stop();
    this.at = Math.min(Math.max(at, 0), this.end);
    this.isLive = !this.times.length || (this.source.isRunning && this.at >= this.end);
    this.#show3D();
    this.#draw();
  }

  toggle() {
    if (this.isPlaying) this.go(this.#now());
    else this.play();
  }

  play() {
    if (this.end) this.#run(this.at >= this.end ? 0 : this.at);
  }

  /** Back to the table as it is now. */
  live() {
    if (this.source?.of.story) return this.source.left(); // its table never was here
    this.#stop();
    this.isLive = true;
    this.at = this.end;
    this.#show3D();
    return this.#draw();
  }

  /** Takes the source off view. */
  close() {
    this.source = null;
    this.live();
  }

  #run(from) {
    this.#stop();
    this.at = this.from = from;
    this.isLive = false;
    this.rate = Number(this.chosen.value);
    this.since = performance.now();
    this.timer = setInterval(() => this.#tick(), TICK_MS);
    this.#show3D();
    this.#draw();
  }

  #stop() {
    clearInterval(this.timer);
    this.timer = 0;
  }

  #now() {
    return this.from + (this.rate * (performance.now() - this.since)) / 1000;
  }

  #tick() {
    const { index, source } = this;
    this.at = Math.min(this.#now(), this.end);
    if (this.at < this.end) return this.#draw(this.index !== index);
    if (byId("timeline-loop").checked) return this.#run(0);
    this.go(this.end);
    return source.ended?.();
  }

  /** An arrow key goes to where the next step is over, or the one before. */
  #step(event) {
    const way = WAYS[event.key];
    if (!way) return;
    event.preventDefault();
    const next = way > 0 ? this.times.find((time) => time > this.at + NEAR_S) : this.times.findLast((time) => time < this.at - NEAR_S);
    if (next !== undefined) this.go(next);
  }

  #show3D() {
    if (this.isLive) showLive();
    else replay({ ...this.source.of, at_s: this.at, plays: this.isPlaying, speed: Number(this.chosen.value) });
  }

  #draw(isOtherStep = true) {
    const { source, slider } = this;
    byId("timeline-bar").hidden = !source;
    byId("pinned").hidden = !source || (this.isLive && !source.isRunning);
    slider.max = this.end;
    slider.value = this.at;
    if (!source || !isOtherStep) return;
    slider.disabled = byId("timeline-play").disabled = !this.end;
    byId("timeline-play").textContent = this.isPlaying ? "❚❚" : "▶";
    byId("timeline-play").setAttribute("aria-label", this.isPlaying ? "Pause the recording" : "Play the recording");
    byId("replaying").hidden = this.isLive;
    byId("replaying").title = source.name;
    byId("back-to-live").setAttribute("aria-pressed", String(this.isLive));
    const [now, all] = [this.index, this.times.length - 1].map((step) => source.actions[step] ?? 0);
    byId("timeline-step").textContent = `${now} / ${all}`;
    slider.setAttribute("aria-valuetext", `Step ${now} of ${all}`);
    source.draw(this.index);
  }

  /** Whoever chooses another table wants to see it. */
  #watchTable() {
    let table;
    watch("scene", (scene) => {
      const isOther = table !== undefined && scene && scene.id !== table;
      table = scene === undefined ? undefined : scene?.id ?? null;
      if (isOther && isDriving() && !this.isLive) this.live();
    });
  }
}

export const timeline = new Timeline();
