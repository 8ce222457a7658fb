// A look into one registration: both maps laid on each other.
import { ask, attributes, element } from "./api.js";

const MODES = { agreement: "where walls agree", slide: "slider", both: "both" };
const LEGEND = [
  ["#004e38", "walls of both"], ["#cc2800", "wall of one in free water of the other"],
  ["#56b4e9", "walls of the target alone"], ["#e69f00", "walls of the source alone"],
];
const at = (id) => document.getElementById(id);

export class PairDialog {
  /** `onLay` is called with the names of two runs and a registration's number. */
  constructor(hand, onLay) {
    this.hand = hand;
    this.onLay = onLay;
    at("pair-close").onclick = () => at("pair").close();
    at("pair-slider").oninput = () => this.#clip();
    for (const [mode, name] of Object.entries(MODES)) {
      const choice = element("input", { type: "radio", name: "pair-mode", value: mode, checked: mode === "agreement", onchange: () => this.#draw() });
      at("pair-modes").append(element("label", {}, choice, ` ${name}`));
    }
    for (const [colour, name] of LEGEND) {
      const swatch = element("span", { className: "swatch" });
      swatch.style.background = colour;
      at("pair-legend").append(element("span", {}, swatch, name));
    }
  }

  /** `edge` is the constraint that was clicked on, if one was. */
  async open(row, edge = null) {
    this.row = row;
    this.ends = edge ? edge.ends : row.references;
    this.rivals = [];
    this.rival = null;
    at("pair-title").textContent = `${row.source} in ${row.target}`;
    const chip = element("span", { className: `chip ${row.verdict === "ACCEPTED" ? "good" : ""}` }, row.verdict);
    at("pair-verdict").replaceChildren(chip, ` ${row.reason}`);
    const [x, y, yaw] = row.pose || [];
    const rows = row.pose ? [["source in target", `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m, ${(yaw * 180 / Math.PI).toFixed(2)}°`],
      ["standard deviations", `${show(row.sigma[0], 2)} m, ${show(row.sigma[1], 2)} m, ${show(row.sigma[2] * 180 / Math.PI, 2)}°`]] : [];
    rows.push(["probability that it is right", show(row.probability)]);
    at("pair-pose").replaceChildren(...rows.map(line));
    at("pair-numbers").replaceChildren(...Object.entries(row.numbers).map(([name, value]) => line([name.replaceAll("_", " "), show(value)])));
    at("pair-rivals").replaceChildren();
    this.#hand();
    if (!at("pair").open) {
      this.hand.into(at("pair"), at("pair-who"));
      at("pair").showModal();
    }
    if (!row.pose) {
      at("pair-stage").replaceChildren(element("p", { className: "empty" }, "There is no pose to draw."));
      return;
    }
    const look = element("button", { type: "button", className: "tool", onclick: () => this.#rivals(look) }, "look for rivals");
    at("pair-rivals").replaceChildren(look);
    this.#draw();
  }

  /** What a person may say of the pair. */
  #hand() {
    const [source, target] = this.ends;
    const runs = this.row.runs;
    const tools = [this.#closing(this.hand.button("forbid this match", { kind: "forbid", source, target }))];
    if (runs[0] !== runs[1]) {
      tools.push(this.#closing(this.hand.button(`never match ${runs[0]} with ${runs[1]}`, { kind: "forbid", is_run: true, source, target })));
    }
    if (this.row.pose) tools.push(this.#closing(this.hand.button("confirm this pose", () => this.#confirmed())));
    if (runs[0] !== runs[1]) {
      const lay = element("button", { type: "button", className: "tool", onclick: () => { at("pair").close(); this.onLay(runs, this.row.number); } }, "lay by hand …");
      tools.push(lay);
    }
    at("pair-hand").replaceChildren(...tools);
  }

  /** What is drawn: the answer's pose or a rival's. */
  #confirmed() {
    const [source, target] = this.row.references;
    const pose = this.rival === null ? this.row.pose : this.rivals[this.rival].pose;
    const [x, y, yaw] = this.row.sigma;
    const sigma_m = Math.max(x || 0, y || 0) || 0.5;
    return { kind: "confirm", source, target, T_target_source: pose, sigma_m, sigma_rad: yaw || 0.05 };
  }

  #closing(button) {
    const act = button.onclick;
    button.onclick = async () => { if (await act()) at("pair").close(); };
    return button;
  }

  async #rivals(button) {
    button.disabled = true;
    button.textContent = "registering once more …";
    const number = this.row.number;
    try {
      const rivals = await ask(`/api/pairs/${number}/rivals`);
      this.rivals = rivals;
      if (this.row.number !== number) return;
      const choose = (rival, made) => {
        this.rival = rival;
        for (const other of at("pair-rivals").children) other.setAttribute("aria-pressed", String(other === made));
        this.#draw();
      };
      const own = attributes(element("button", { type: "button", className: "tool", onclick: () => choose(null, own) }, "the answer"), { "aria-pressed": "true" });
      const others = rivals.map((rival, index) => {
        const [x, y, yaw] = rival.pose;
        const made = element("button", { type: "button", className: "tool", onclick: () => choose(index, made) }, `x ${x.toFixed(1)} m, y ${y.toFixed(1)} m, ${(yaw * 180 / Math.PI).toFixed(0)}°: ${(100 * rival.score_share).toFixed(0)} % of the score`);
        return attributes(made, { "aria-pressed": "false" });
      });
      at("pair-rivals").replaceChildren(own, ...others, others.length ? "" : "There are no rivals.");
    } catch (error) {
      at("pair-rivals").replaceChildren(error.message);
    }
  }

  #draw() {
    const mode = document.querySelector('input[name="pair-mode"]:checked').value;
    at("pair-slide").hidden = mode !== "slide";
    at("pair-slide").style.display = mode === "slide" ? "" : "none";
    const layers = mode === "agreement" ? ["agreement"] : ["target", "source"];
    const query = this.rival === null ? "" : `?rival=${this.rival}`;
    at("pair-stage").replaceChildren(...layers.map((layer) => element("img", {
      src: `/api/pairs/${this.row.number}/${layer}.png${query}`, alt: `${layer} of ${this.row.source} in ${this.row.target}`,
      onerror: () => at("pair-stage").replaceChildren("This pair cannot be drawn any more."),
    })));
    if (mode === "both") at("pair-stage").lastChild.style.mixBlendMode = "multiply";
    if (mode === "slide") {
      at("pair-stage").append(element("div", { className: "cut" }));
      this.#clip();
    }
  }

  #clip() {
    const [source, cut] = [at("pair-stage").querySelectorAll("img")[1], at("pair-stage").querySelector(".cut")];
    if (!source || !cut) return;
    const share = Number(at("pair-slider").value);
    source.style.clipPath = `inset(0 0 0 ${100 - share}%)`;
    source.style.background = "var(--water)";
    cut.style.left = `${100 - share}%`;
  }
}

function line([name, value]) {
  return element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, String(value)));
}

function show(value, digits = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "not known";
  return Math.abs(value) >= 1000 || Number.isInteger(value) ? String(value) : Number(value).toPrecision(digits);
}
