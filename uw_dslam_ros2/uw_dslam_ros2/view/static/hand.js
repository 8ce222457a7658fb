// What a person decides: who it is, what is said of it, and the forms for it.
import { element, tell } from "./api.js";

const WORDS = {
  withdraw: (ends) => `${ends[0]} withdrawn`,
  restore: (ends) => `${ends[0]} restored`,
  forbid: (ends) => `${ends[0]} and ${ends[1]} are never matched`,
  confirm: (ends) => `${ends[0]} lies in ${ends[1]} as it was laid`,
  register: (ends) => `${ends[0]} is searched in ${ends[1]} where it was laid`,
  pin: (ends) => `the frame is that of ${ends[0]}`,
  fix: (ends) => `fix in ${ends[0]}`,
};

/** A decision in words. */
export function worded(row) {
  if (row.kind === "undo") return `decision ${row.undone} undone`;
  return WORDS[row.kind](row.is_run ? row.ends.map((name) => `all of ${name}`) : row.ends);
}

export class Hand {
  /** `box` holds `who`, an input, and `said`, a place for one line. */
  constructor(box, who, said) {
    this.box = box;
    this.home = document.createComment("the hand's place");
    box.before(this.home);
    this.who = who;
    this.said = said;
    who.value = localStorage.getItem("uw-view-who") || "";
    who.oninput = () => localStorage.setItem("uw-view-who", who.value);
  }

  /** Goes along into a dialog, beside which nothing else can be used. */
  into(dialog, place) {
    place.append(this.box);
    dialog.addEventListener("close", () => this.home.after(this.box), { once: true });
    this.tell("");
  }

  /** True once it stands in the log; else the reason is on the page. */
  async decide(decision) {
    if (!this.who.value.trim()) {
      this.tell("Say who decides: your name goes into the log.");
      this.who.focus();
      return false;
    }
    try {
      const taken = await tell("/api/decide", { ...decision, who: this.who.value.trim() });
      this.tell(`Decision ${taken.number} is noted.`);
      return true;
    } catch (error) {
      this.tell(error.message, true);
      return false;
    }
  }

  tell(text, isBad = false) {
    this.said.textContent = text;
    this.said.className = isBad ? "bad" : "";
  }

  button(label, decision) {
    const made = element("button", { type: "button", className: "tool" }, label);
    made.onclick = async () => {
      made.disabled = true;
      const isDone = await this.decide(typeof decision === "function" ? decision() : decision);
      made.disabled = false;
      return isDone;
    };
    return made;
  }

  /** Where a point of a submap lies on earth. */
  fixForm(source, point) {
    const frame = field("coordinates", "text", localStorage.getItem("uw-view-frame") || "", "EPSG:32632");
    const [x, y] = [field("x [m]", "number", ""), field("y [m]", "number", "")];
    const sigma = field("± [m]", "number", "2");
    const yaw = field("turned by [°], if known", "number", "");
    const sure = field("± [°]", "number", "2");
    const place = this.button("place the fix", () => {
      localStorage.setItem("uw-view-frame", frame.input.value);
      const turn = yaw.input.value === "" ? {} : { sigma_rad: radians(sure.input.value) };
      return {
        kind: "fix", source, point, earth_frame: frame.input.value, sigma_m: number(sigma.input.value), ...turn,
        place: [number(x.input.value), number(y.input.value), radians(yaw.input.value || "0")],
      };
    });
    return element("details", { className: "form" }, element("summary", {}, "fix this place on earth"), ...[frame, x, y, sigma, yaw, sure].map((f) => f.label), place);
  }
}

export function field(label, type, value, placeholder = "") {
  const input = element("input", { type, value, placeholder, step: "any" });
  return { input, label: element("label", { className: "field" }, `${label} `, input) };
}

export function number(text) {
  return text === "" ? Number.NaN : Number(text);
}

export function radians(text) {
  return (number(text) * Math.PI) / 180;
}
