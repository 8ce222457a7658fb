// What the map shows, and what its lines mean.
import { attributes, element } from "./api.js";
import { kinds_in } from "./edges.js";

const NAMES = { tracks: "tracks", constraints: "matches", submaps: "outlines of submaps", odometry: "odometry" };
const AT_FIRST = ["tracks", "constraints"];
const SVG = "http://www.w3.org/2000/svg";

export class Layers {
  /** `toggle` is called with a layer's name and whether it is shown. */
  constructor(toggle) {
    this.lines = element("ul");
    const choices = Object.entries(NAMES).map(([name, label]) => {
      const box = element("input", { type: "checkbox", checked: AT_FIRST.includes(name), onchange: () => toggle(name, box.checked) });
      const choice = element("label", {}, box, ` ${label}`);
      return name === "constraints" ? element("div", {}, choice, this.lines) : choice;
    });
    for (const name of AT_FIRST) toggle(name, true);
    const isWide = matchMedia("(min-width: 761px)").matches;
    const box = element("details", { className: "layers", open: isWide }, element("summary", {}, "Layers"), ...choices);
    L.DomEvent.disableClickPropagation(box);
    L.DomEvent.disableScrollPropagation(box);
    this.control = L.control({ position: "topright" });
    this.control.onAdd = () => box;
  }

  show(scene) {
    this.lines.replaceChildren(...kinds_in(scene.constraints).map(({ line, words }) => element("li", {}, sample(line), words)));
  }
}

function sample({ color, weight, dashArray }) {
  const line = attributes(document.createElementNS(SVG, "line"), { x1: 0, x2: 26, y1: 4, y2: 4, stroke: color, "stroke-width": weight, "stroke-dasharray": dashArray || "none" });
  const picture = attributes(document.createElementNS(SVG, "svg"), { viewBox: "0 0 26 8", "aria-hidden": "true" });
  picture.append(line);
  return picture;
}
