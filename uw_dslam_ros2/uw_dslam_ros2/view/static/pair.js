// A look into one registration: both maps laid on each other.
import { ask, attributes, element } from "./api.js";

const MODES = { agreement: "where walls agree", slide: "slider", both: "both" };
const LEGEND = [
  ["#004e38", "walls of both"], ["#cc2800", "wall of one in free water of the other"],
  ["#56b4e9", "walls of the target alone"], ["#e69f00", "walls of the source alone"],
];
const at = (id) => document.getElementById(id);

export class PairDialog {
  constructor() {
    at("pair-close").onclick = () => at("pair").close();
    at("pair-slider").oninput = () => this.#clip();
    for (const [mode, name] of Object.entries(MODES)) {
      const choice = element("input", { type: "radio", name: "pair-mode", value: mode, checked: mode === "agreement", onchange: () => this.#draw() });
      at("pair-modes").append(element("label", {}, choice, ` ${name} `));
    }
    for (const [colour, name] of LEGEND) {
      const swatch = element("span", { className: "swatch" });
      swatch.style.background = colour;
      at("pair-legend").append(element("span", {}, swatch, `${name}   `));
    }
  }

  async open(row) {
    this.row = row;
    this.rival = null;
    at("pair-title").textContent = `${row.source} in ${row.target}`;
    const chip = element("span", { className: `chip ${row.verdict === "ACCEPTED" ? "good" : ""}` }, row.verdict);
    at("pair-verdict").replaceChildren(chip, ` ${row.reason}`);
    const [x, y, yaw] = row.pose || [];
    const rows = row.pose ? [["pose of the source in the target", `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m, ${(yaw * 180 / Math.PI).toFixed(2)}°`],
      ["standard deviations", `${show(row.sigma[0])} m, ${show(row.sigma[1])} m, ${show(row.sigma[2] * 180 / Math.PI)}°`]] : [];
    rows.push(["probability that it is right", show(row.probability)]);
    for (const [name, value] of Object.entries(row.numbers)) rows.push([name.replaceAll("_", " "), show(value)]);
    at("pair-numbers").replaceChildren(...rows.map(([name, value]) => element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, String(value)))));
    at("pair-rivals").replaceChildren();
    if (!at("pair").open) at("pair").showModal();
    if (!row.pose) {
      at("pair-stage").replaceChildren("There is no pose to draw.");
      return;
    }
    const look = element("button", { onclick: () => this.#rivals(look) }, "look for rivals");
    at("pair-rivals").replaceChildren(look);
    this.#draw();
  }

  async #rivals(button) {
    button.disabled = true;
    button.textContent = "registering once more …";
    const number = this.row.number;
    try {
      const rivals = await ask(`/api/pairs/${number}/rivals`);
      if (this.row.number !== number) return;
      const choose = (rival, made) => {
        this.rival = rival;
        for (const other of at("pair-rivals").children) other.setAttribute("aria-pressed", String(other === made));
        this.#draw();
      };
      const own = attributes(element("button", { onclick: () => choose(null, own) }, "the answer"), { "aria-pressed": "true" });
      const others = rivals.map((rival, index) => {
        const [x, y, yaw] = rival.pose;
        const made = element("button", { onclick: () => choose(index, made) }, `x ${x.toFixed(1)} m, y ${y.toFixed(1)} m, ${(yaw * 180 / Math.PI).toFixed(0)}°: ${(100 * rival.score_share).toFixed(0)} % of the score`);
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
    if (mode === "slide") this.#clip();
  }

  #clip() {
    const source = at("pair-stage").lastChild;
    if (!(source instanceof HTMLImageElement)) return;
    const share = Number(at("pair-slider").value);
    source.style.clipPath = `inset(0 0 0 ${100 - share}%)`;
    source.style.background = "#cfd8df";
  }
}

function show(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "not known";
  return Math.abs(value) >= 1000 || Number.isInteger(value) ? String(value) : Number(value).toPrecision(4);
}
