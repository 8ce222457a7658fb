// The lists beside the map.
import { attributes, clock, day, element, style_of } from "./api.js";
import { told } from "./edges.js";
import { worded } from "./hand.js";

const TABS = { vehicles: "Vehicles", matches: "Matches", submaps: "Submaps", cell: "Cell", decisions: "Decisions", health: "Health" };
const OF_STATUS = ["vehicles", "health"];
const OLD_S = 5;

export class Panel {
  constructor(tabs, content, actions, hand) {
    this.hand = hand;
    this.tabs = tabs;
    this.content = content;
    this.actions = actions;
    this.current = "vehicles";
    this.found = null;
    this.status = {};
    this.opened = new Set();
    const names = Object.keys(TABS);
    for (const name of names) {
      const tab = element("button", { id: `tab-${name}`, type: "button", onclick: () => this.open(name) }, TABS[name]);
      tab.onkeydown = (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (step) this.open(names[(names.indexOf(name) + step + names.length) % names.length], true);
      };
      tabs.append(attributes(tab, { role: "tab" }));
    }
  }

  /** Whether what is open shows what changes without the map changing. */
  get showsStatus() {
    return OF_STATUS.includes(this.current);
  }

  show(scene) {
    this.scene = scene;
    this.colours = new Map(scene.vehicles.map((vehicle, index) => [vehicle.name, style_of(index).color]));
    // What somebody is writing is not taken away.
    if (!this.content.querySelector("details.form[open]")) this.open(this.current);
  }

  open(name, isFocused = false) {
    this.current = name;
    for (const tab of this.tabs.children) {
      const isOn = tab.id === `tab-${name}`;
      attributes(tab, { "aria-selected": String(isOn), tabindex: isOn ? "0" : "-1" });
      if (isOn && isFocused) tab.focus();
    }
    if (!this.scene) return;
    const held = path_to(document.activeElement, this.content);
    this.content.replaceChildren(...this[`_${name}`]());
    // Who uses the keys stays where they were.
    const again = held && at_path(held, this.content);
    if (again) again.focus({ preventScroll: true });
  }

  showCell(cell) {
    this.wasAsked = true;
    this.found = cell;
    this.open("cell");
  }

  showSubmap(name) {
    this.opened.add(`submap ${name}`);
    this.open("submaps");
    this.#reveal(`[data-name="${CSS.escape(name)}"]`);
  }

  showDecision(number) {
    this.open("decisions");
    this.#reveal(`[data-number="${number}"]`);
  }

  #reveal(selector) {
    const card = this.content.querySelector(selector);
    if (card) card.scrollIntoView({ block: "center" });
  }

  #swatch(name) {
    const swatch = element("span", { className: "swatch" });
    swatch.style.background = this.colours.get(name);
    return swatch;
  }

  /** A card that opens, and stays open when what it shows changes. */
  #folded(key, summary, ...inner) {
    return element("details", { className: "card", open: this.opened.has(key), ontoggle: (event) => this.opened[event.target.open ? "add" : "delete"](key) },
      element("summary", {}, ...summary), ...inner);
  }

  _vehicles() {
    const notes = (this.status.notes || []).map((note) => element("p", { className: "card note" }, note));
    const cards = this.scene.vehicles.map((vehicle) => {
      const age = (this.status.ages || {})[vehicle.name];
      const isOut = vehicle.num_withdrawn === vehicle.num_submaps;
      const name = element("button", { type: "button", className: "link", title: "show it on the map", onclick: () => this.actions.zoom(vehicle.name) }, vehicle.name);
      const state = chip(isOut ? "withdrawn" : vehicle.num_merged > 0 ? "merged" : "by itself", vehicle.num_merged > 0 ? "good" : isOut ? "off" : "");
      const said = this.hand.button(isOut ? "restore the run" : "withdraw the run", { kind: isOut ? "restore" : "withdraw", source: vehicle.id, is_run: true });
      return element("div", { className: "card" },
        element("div", { className: "row" }, this.#swatch(vehicle.name), name, state),
        element("small", {}, `${vehicle.num_merged} of ${vehicle.num_submaps} submaps in the map${age === undefined ? "" : `, last message ${age.toFixed(0)} s ago`}`),
        element("small", {}, vehicle.reason),
        element("div", { className: "tools" }, said));
    });
    return [...notes, ...(cards.length ? cards : [empty("No submap has come yet.")])];
  }

  _matches() {
    const rows = [...this.scene.registrations].sort((a, b) => Number(b.is_used) - Number(a.is_used) || b.probability - a.probability);
    if (!rows.length) {
      const edges = this.scene.constraints.filter((edge) => edge.kind === "registration");
      return edges.length ? edges.map((edge) => element("p", { className: "card" }, told(edge))) : [empty("Nothing has been registered yet.")];
    }
    const holding = rows.filter((row) => row.is_used).length;
    const cards = rows.map((row) => {
      const state = row.is_used ? chip("holds", "good") : row.verdict === "ACCEPTED" ? chip("taken out") : chip(row.verdict, "off");
      const picture = row.look && element("img", { loading: "lazy", alt: "", src: `/api/pairs/${row.number}/agreement.png?side=136&look=${row.look}` });
      return element("button", { type: "button", className: "card match", onclick: () => this.actions.pair(row) }, picture,
        element("span", {},
          element("span", { className: "row" }, element("b", {}, this.#swatch(row.runs[0]), ` ${row.source} in `, this.#swatch(row.runs[1]), ` ${row.target}`), state),
          element("small", {}, row.reason)));
    });
    return [element("p", { className: "soft" }, `${holding} of ${rows.length} registrations hold; a click shows why`), ...cards];
  }

  _submaps() {
    const cards = this.scene.submaps.map((submap) => {
      const isOut = submap.state === "withdrawn";
      const switched = this.hand.button(isOut ? "restore" : "withdraw", { kind: isOut ? "restore" : "withdraw", source: submap.id });
      const pin = this.hand.button("pin the frame here", { kind: "pin", source: submap.id });
      const card = this.#folded(`submap ${submap.name}`,
        [element("span", { className: "row" }, this.#swatch(submap.vehicle), element("b", {}, submap.name), element("small", {}, clock(submap.stamp_s)), chip(submap.state, submap.state === "merged" ? "good" : "off"))],
        element("small", {}, `revision ${submap.revision}, ${submap.is_final ? "closed" : "still growing"}`),
        element("small", {}, submap.reason),
        element("div", { className: "tools" }, switched, ...(isOut ? [] : [pin])),
        ...(isOut ? [] : [this.hand.fixForm(submap.id, [0, 0])]));
      card.dataset.name = submap.name;
      return card;
    });
    return cards.length ? cards : [empty("No submap has come yet.")];
  }

  _decisions() {
    const lay = element("button", { type: "button", className: "tool", disabled: this.scene.vehicles.length < 2, onclick: () => this.actions.lay() }, "lay one map on another …");
    const earth = this.scene.earth && element("p", { className: "card" }, `The map lies on earth (${this.scene.earth.frame}): x ${this.scene.earth.pose[0].toFixed(2)} m, y ${this.scene.earth.pose[1].toFixed(2)} m, turned by ${(this.scene.earth.pose[2] * 180 / Math.PI).toFixed(2)}°.`);
    const cards = [...this.scene.decisions].reverse().map((row) => {
      const card = element("div", { className: row.is_in_force ? "card" : "card undone" },
        element("b", {}, `${row.number}: ${worded(row)}`),
        element("small", {}, `${row.who || "somebody"}, ${day(row.stamp_s)} ${clock(row.stamp_s)}`),
        ...(row.remark ? [element("small", {}, row.remark)] : []));
      if (row.is_in_force) card.append(element("div", { className: "tools" }, this.hand.button("undo", { kind: "undo", undone: row.number })));
      card.dataset.number = row.number;
      return card;
    });
    const none = empty("Nobody has decided anything yet. Matches, submaps and vehicles have buttons for it; each decision is listed here and can be undone.");
    return [element("div", { className: "tools" }, lay), ...(earth ? [earth] : []), ...(cards.length ? cards : [none])];
  }

  _health() {
    const rows = this.status.diagnostics || [];
    if (!rows.length) return [empty(this.status.is_live ? "No node has told of itself yet." : "This is a saved merge: no node runs.")];
    const links = rows.filter((row) => row.sent_bytes !== undefined);
    const sent = links.map((row) => element("tr", {}, element("td", {}, row.name.split(":")[0]), element("td", {}, `${row.sent_bytes} bytes`), element("td", {}, row.bits_per_s === null ? "" : `${row.bits_per_s.toFixed(0)} bit/s`)));
    const cards = rows.map((row) => this.#folded(row.name,
      [element("span", { className: "row" }, element("b", {}, row.name.split(":")[0]), chip(row.level, row.level === "ok" ? "good" : "")),
        element("small", {}, `${row.message}${row.age_s > OLD_S ? `, ${row.age_s.toFixed(0)} s ago` : ""}`)],
      element("table", {}, ...Object.entries(row.values).map(([key, value]) => element("tr", {}, element("th", { scope: "row" }, key), element("td", {}, value))))));
    return [...(links.length ? [element("h3", {}, "sent over the acoustic link"), element("table", {}, ...sent)] : []), ...cards];
  }

  _cell() {
    if (this.wasAsked && !this.found) return [empty("Nothing was seen here.")];
    if (!this.found) return [empty("Click on the map, or press Enter on it, to see which submaps saw a cell and what they say of it.")];
    const owners = new Map(this.scene.submaps.map((submap) => [submap.name, submap.vehicle]));
    const rows = Object.entries(this.found.percent).map(([name, percent]) => element("tr", {}, element("td", {}, this.#swatch(owners.get(name)), ` ${name}`), element("td", {}, `${percent} %`), element("td", {}, percent > 50 ? "wall" : "free")));
    return [
      element("p", {}, element("b", {}, `x ${this.found.x_m} m, y ${this.found.y_m} m`)),
      element("p", {}, `${this.found.num_occupied} submaps say wall, ${this.found.num_free} say free`),
      element("table", {}, ...rows),
      this.hand.fixForm(...Object.values(this.found.points)[0]),
    ];
  }
}

function chip(words, kind = "") {
  return element("span", { className: `chip ${kind}` }, words);
}

function empty(words) {
  return element("p", { className: "empty" }, words);
}

/** Which child of which child an element is; null outside `root`. */
function path_to(child, root) {
  const path = [];
  for (let one = child; one !== root; one = one.parentElement) {
    if (!one || !one.parentElement) return null;
    path.unshift([...one.parentElement.children].indexOf(one));
  }
  return path.length ? path : null;
}

function at_path(path, root) {
  return path.reduce((one, index) => one && one.children[index], root);
}
