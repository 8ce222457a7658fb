// Two maps, one of which a person drags and turns until it lies right.
import { ask, element } from "./api.js";
import { radians } from "./hand.js";

const at = (id) => document.getElementById(id);
const STEP_M = 0.5;
const STEP_RAD = (5 * Math.PI) / 180;

export class LayDialog {
  constructor(hand) {
    this.hand = hand;
    at("lay-close").onclick = () => at("lay").close();
    for (const side of ["source", "target"]) at(`lay-${side}`).onchange = () => this.#load(null);
    for (const name of ["x", "y", "yaw"]) at(`lay-${name}`).oninput = () => this.#typed();
    at("lay-turn").oninput = () => this.#turn(radians(at("lay-turn").value) - this.pose[2]);
    at("lay-larger").onclick = () => this.#zoom(1.25);
    at("lay-smaller").onclick = () => this.#zoom(0.8);
    at("lay-register").onclick = () => this.#decide("register");
    at("lay-confirm").onclick = () => this.#decide("confirm");
    const stage = at("lay-stage");
    stage.onpointerdown = (event) => this.#drag(event);
    stage.onkeydown = (event) => this.#key(event);
    stage.onwheel = (event) => { event.preventDefault(); this.#zoom(event.deltaY < 0 ? 1.1 : 0.9); };
  }

  /** `runs` are the names of all; `chosen` of source and target; `match` a registration to start from. */
  async open(runs, chosen = [], match = null) {
    const [source, target] = [chosen[0] || runs[1], chosen[1] || runs[0]];
    for (const [side, name] of [["source", source], ["target", target]]) {
      at(`lay-${side}`).replaceChildren(...runs.map((run) => element("option", { value: run, selected: run === name }, run)));
    }
    if (!at("lay").open) {
      this.hand.into(at("lay"), at("lay-who"));
      at("lay").showModal();
    }
    await this.#load(match);
    at("lay-stage").focus();
  }

  async #load(match) {
    const [source, target] = [at("lay-source").value, at("lay-target").value];
    const query = new URLSearchParams({ source, target, ...(match === null ? {} : { match }) });
    this.maps = null;
    at("lay-stage").replaceChildren();
    at("lay-said").textContent = "";
    try {
      const laid = await ask(`/api/lay?${query}`);
      this.maps = laid;
      this.pose = laid.start;
    } catch (error) {
      at("lay-said").textContent = error.message;
      return;
    }
    this.images = ["target", "source"].map((layer) => {
      const run = layer === "target" ? target : source;
      return element("img", { alt: `map of ${run}`, draggable: false, src: `/api/lay.png?${new URLSearchParams({ run, layer })}` });
    });
    at("lay-stage").replaceChildren(...this.images);
    this.#fit();
  }

  /** Both maps in sight. */
  #fit() {
    const points = ["source", "target"].flatMap((side) => corners(this.maps[side], side === "source" ? this.pose : [0, 0, 0]));
    const [xs, ys] = [points.map((p) => p[0]), points.map((p) => p[1])];
    const stage = at("lay-stage").getBoundingClientRect();
    const [width, height] = [Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)];
    this.scale = 0.9 * Math.min(stage.width / width, stage.height / height);
    this.middle = [Math.min(...xs) + width / 2, Math.min(...ys) + height / 2];
    this.#draw();
  }

  #zoom(factor) {
    if (!this.maps) return;
    this.scale *= factor;
    this.#draw();
  }

  #draw() {
    const stage = at("lay-stage").getBoundingClientRect();
    ["target", "source"].forEach((side, index) => {
      const { rows, resolution_m: r, grid } = this.maps[side];
      const [x, y, yaw] = side === "source" ? composed(this.pose, grid) : grid;
      const [c, s, k] = [Math.cos(yaw), Math.sin(yaw), this.scale * r];
      // Pictures have their first row on top; metres grow upwards.
      const right = stage.width / 2 + this.scale * (x - this.middle[0] - s * rows * r);
      const down = stage.height / 2 - this.scale * (y - this.middle[1] + c * rows * r);
      this.images[index].style.transform = `matrix(${k * c}, ${-k * s}, ${k * s}, ${k * c}, ${right}, ${down})`;
    });
    const [x, y, yaw] = this.pose;
    const degrees = (yaw * 180) / Math.PI;
    for (const [name, value] of [["x", x.toFixed(2)], ["y", y.toFixed(2)], ["yaw", degrees.toFixed(1)]]) {
      if (document.activeElement !== at(`lay-${name}`)) at(`lay-${name}`).value = value;
    }
    at("lay-turn").value = degrees;
  }

  #move(dx, dy) {
    this.pose = [this.pose[0] + dx, this.pose[1] + dy, this.pose[2]];
    this.#draw();
  }

  /** About the middle of the map that is turned. */
  #turn(angle) {
    if (!this.maps) return;
    const points = corners(this.maps.source, this.pose);
    const [mx, my] = [0, 1].map((axis) => points.reduce((sum, p) => sum + p[axis], 0) / points.length);
    const [dx, dy, c, s] = [this.pose[0] - mx, this.pose[1] - my, Math.cos(angle), Math.sin(angle)];
    this.pose = [mx + c * dx - s * dy, my + s * dx + c * dy, wrapped(this.pose[2] + angle)];
    this.#draw();
  }

  #typed() {
    const values = [Number(at("lay-x").value), Number(at("lay-y").value), radians(at("lay-yaw").value || "0")];
    if (!this.maps || !values.every(Number.isFinite)) return;
    this.pose = [values[0], values[1], wrapped(values[2])];
    this.#draw();
  }

  #drag(event) {
    if (!this.maps) return;
    const stage = at("lay-stage");
    stage.setPointerCapture(event.pointerId);
    stage.focus();
    let last = [event.clientX, event.clientY];
    stage.onpointermove = (moved) => {
      const [dx, dy] = [moved.clientX - last[0], moved.clientY - last[1]];
      last = [moved.clientX, moved.clientY];
      if (moved.shiftKey) this.#turn(-dx / 100);
      else this.#move(dx / this.scale, -dy / this.scale);
    };
    stage.onpointerup = stage.onpointercancel = () => { stage.onpointermove = null; };
  }

  #key(event) {
    if (!this.maps) return;
    const fine = event.shiftKey ? 0.1 : 1;
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const turns = { PageUp: 1, PageDown: -1 };
    if (moves[event.key]) this.#move(...moves[event.key].map((step) => step * STEP_M * fine));
    else if (turns[event.key]) this.#turn(turns[event.key] * STEP_RAD * fine);
    else return;
    event.preventDefault();
  }

  async #decide(kind) {
    if (!this.maps) return;
    const [metres, angle] = [Number(at("lay-off-m").value), radians(at("lay-off-deg").value)];
    const how = kind === "register" ? { is_run: true, half_width_m: metres, half_width_rad: angle } : { sigma_m: metres / 2, sigma_rad: angle / 2 };
    const isDone = await this.hand.decide({ kind, source: this.maps.source.id, target: this.maps.target.id, T_target_source: this.pose, ...how });
    if (isDone) at("lay").close();
  }
}

function wrapped(angle) {
  return Math.atan2(Math.sin(angle), Math.cos(angle));
}

function composed([x, y, yaw], [u, v, turn]) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [x + c * u - s * v, y + s * u + c * v, yaw + turn];
}

function corners({ rows, cols, resolution_m: r, grid }, pose) {
  const place = composed(pose, grid);
  return [[0, 0], [cols * r, 0], [0, rows * r], [cols * r, rows * r]].map(([u, v]) => composed(place, [u, v, 0]));
}
