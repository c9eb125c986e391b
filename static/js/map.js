// The table from above: objects to drag, turn and move by keys. It knows nothing of goals; it tells where things are put.
import { svg } from "./curves.js";
import { objects } from "./state.js";

const CM = 100;
const REACH_CM = 28; // as far from the middle as an object may be put
const WORKSPACE_CM = 22;
const DISC_CM = 4; // of an object whose size is not known
const TURN_DEG = 15;
const ARROWS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowRight: [1, 0], ArrowLeft: [-1, 0] };

const clamp = (value) => Math.min(Math.max(value, -REACH_CM), REACH_CM);

function rotated([w, x, y, z], [a, b, c]) {
  const [u, v, t] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u];
}

/** A quaternion turned about the vertical. */
function turned([w, x, y, z], radians) {
  const [c, s] = [Math.cos(radians / 2), Math.sin(radians / 2)];
  return [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w];
}

/** The convex outline of points in the plane, by Andrew's monotone chain. */
function outline(points) {
  const sorted = [...points].sort(([ax, ay], [bx, by]) => ax - bx || ay - by);
  const half = (all) => {
    const chain = [];
    for (const [x, y] of all) {
      while (chain.length > 1) {
        const [[ax, ay], [bx, by]] = chain.slice(-2);
        if ((bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0) break;
        chain.pop();
      }
      chain.push([x, y]);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

/** An object's shadow at noon, around its own middle [cm]. */
function footprint({ name, quaternion }) {
  const size = objects().find((object) => object.name === name)?.size_m;
  if (!size) return Array.from({ length: 16 }, (_, i) => [DISC_CM * Math.cos((i * Math.PI) / 8), DISC_CM * Math.sin((i * Math.PI) / 8)]);
  const corners = [];
  for (const i of [-0.5, 0.5]) for (const j of [-0.5, 0.5]) for (const k of [-0.5, 0.5]) {
    const [x, y] = rotated(quaternion, [i * size[0], j * size[1], k * size[2]]);
    corners.push([CM * x, CM * y]);
  }
  return outline(corners);
}

const pointsOf = (object) => footprint(object).map(([x, y]) => `${x.toFixed(2)},${(-y).toFixed(2)}`).join(" ");
const placeOf = ({ position: [x, y] }) => `translate(${(CM * x).toFixed(2)} ${(-CM * y).toFixed(2)})`;

export class TableMap {
  /** `onChange` is told all objects after each move, `onChoose` the one that is chosen; `mayMove` is asked before a move. */
  constructor(node, { onChange, onChoose, mayMove }) {
    Object.assign(this, { node, onChange, onChoose, mayMove, objects: [], marks: new Map(), chosen: null, drag: null });
    this.ghosts = svg("g", { class: "map-now", "aria-hidden": "true" });
    this.layer = svg("g", {});
    const frame = svg("rect", { x: -WORKSPACE_CM, y: -WORKSPACE_CM, width: 2 * WORKSPACE_CM, height: 2 * WORKSPACE_CM, class: "map-frame" });
    const axes = svg("path", { d: "M-33 33h7m-1.4-1.4 1.4 1.4-1.4 1.4M-33 33v-7m-1.4 1.4 1.4-1.4 1.4 1.4", class: "map-axes" });
    const names = [svg("text", { x: -25, y: 34 }, "x"), svg("text", { x: -33.8, y: 24.5 }, "y")];
    node.append(frame, axes, ...names, this.ghosts, this.layer);
    node.addEventListener("pointerdown", (event) => this.#grab(event));
    node.addEventListener("pointermove", (event) => this.#pull(event));
    for (const end of ["pointerup", "pointercancel"]) node.addEventListener(end, () => { this.drag = null; });
  }

  get isDragging() {
    return this.drag !== null;
  }

  /** Where things are now, in the background. */
  showNow(now) {
    this.ghosts.replaceChildren(...now.map((object) => svg("polygon", { points: pointsOf(object), transform: placeOf(object) })));
  }

  show(all) {
    this.objects = all;
    if ([...this.marks.keys()].join() !== all.map((object) => object.name).join()) this.#make(all);
    for (const object of all) this.#place(object);
  }

  choose(name) {
    this.chosen = name;
    for (const [other, { group }] of this.marks) group.classList.toggle("chosen", other === name);
    this.onChoose(this.#object(name));
  }

  /** Turns the chosen object about the vertical, to the left if positive [deg]. */
  turn(sign) {
    const object = this.#object(this.chosen);
    if (object) this.#change(object, { quaternion: turned(object.quaternion, (sign * TURN_DEG * Math.PI) / 180) });
  }

  #object(name) {
    return this.objects.find((object) => object.name === name);
  }

  #make(all) {
    this.marks.clear();
    this.layer.replaceChildren(...all.map((object) => {
      const group = svg("g", { class: "map-object", tabindex: 0, role: "button", "data-object": object.name });
      const shape = svg("polygon", {});
      const handle = svg("circle", { r: 1.8, class: "map-handle" });
      const arm = svg("line", { class: "map-arm" });
      group.append(arm, shape, svg("text", {}, object.label), handle);
      group.addEventListener("focus", () => this.choose(object.name));
      group.addEventListener("keydown", (event) => this.#key(event, object.name));
      this.marks.set(object.name, { group, shape, handle, arm });
      return group;
    }));
    this.choose(all[0]?.name ?? null);
  }

  #place(object) {
    const { group, shape, handle, arm } = this.marks.get(object.name);
    const corners = footprint(object);
    const radius = Math.max(...corners.map(([x, y]) => Math.hypot(x, y))) + 2.5;
    const [w, x, y, z] = object.quaternion;
    const heading = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    const [hx, hy] = [radius * Math.cos(heading), -radius * Math.sin(heading)];
    group.setAttribute("transform", placeOf(object));
    const [px, py] = object.position.map((value) => (CM * value).toFixed(1));
    group.setAttribute("aria-label", `${object.label} at x ${px}, y ${py} cm; arrow keys move it, brackets turn it`);
    shape.setAttribute("points", pointsOf(object));
    for (const [name, value] of Object.entries({ cx: hx, cy: hy })) handle.setAttribute(name, value.toFixed(2));
    for (const [name, value] of Object.entries({ x1: 0, y1: 0, x2: hx, y2: hy })) arm.setAttribute(name, value.toFixed(2));
  }

  #change(object, what) {
    if (!this.mayMove()) return;
    const changed = { ...object, ...what };
    this.objects = this.objects.map((other) => (other.name === object.name ? changed : other));
    this.#place(changed);
    this.onChange(this.objects);
  }

  #key(event, name) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const object = this.#object(name);
    const turn = { "[": 1, "]": -1 }[event.key];
    if (event.key in ARROWS) {
      const step = event.shiftKey ? 0.1 : 1;
      const [dx, dy] = ARROWS[event.key];
      const [x, y, z] = object.position;
      this.#change(object, { position: [clamp(CM * x + step * dx) / CM, clamp(CM * y + step * dy) / CM, z] });
    } else if (turn) {
      this.turn(turn);
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation(); // arrows elsewhere on the page push
  }

  /** Where the pointer is [cm]. */
  #at(event) {
    const box = this.node.getBoundingClientRect();
    const { x, y, width, height } = this.node.viewBox.baseVal;
    return [x + ((event.clientX - box.left) / box.width) * width, -(y + ((event.clientY - box.top) / box.height) * height)];
  }

  #grab(event) {
    const group = event.target.closest("[data-object]");
    if (!group || event.button !== 0) return;
    const object = this.#object(group.dataset.object);
    const [x, y] = this.#at(event);
    const [ox, oy] = object.position.map((value) => CM * value);
    this.drag = {
      name: object.name, isTurn: event.target.classList.contains("map-handle"), offset: [ox - x, oy - y],
      angle: Math.atan2(y - oy, x - ox), quaternion: object.quaternion,
    };
    this.node.setPointerCapture(event.pointerId);
    group.focus();
  }

  #pull(event) {
    if (!this.drag) return;
    const object = this.#object(this.drag.name);
    const [x, y] = this.#at(event);
    if (this.drag.isTurn) {
      const angle = Math.atan2(y - CM * object.position[1], x - CM * object.position[0]);
      this.#change(object, { quaternion: turned(this.drag.quaternion, angle - this.drag.angle) });
    } else {
      const [dx, dy] = this.drag.offset;
      this.#change(object, { position: [clamp(x + dx) / CM, clamp(y + dy) / CM, object.position[2]] });
    }
  }
}
