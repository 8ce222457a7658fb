// The lists beside the map.
import { attributes, clock, day, element, style_of } from "./api.js";
import { worded } from "./hand.js";
import { told } from "./map.js";

const TABS = { vehicles: "Vehicles", matches: "Matches", submaps: "Submaps", cell: "Cell", decisions: "Decisions", health: "Health" };
const LAYERS = { tracks: "tracks", submaps: "submaps", constraints: "matches", odometry: "odometry" };

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
    this.layers = { tracks: true, submaps: false, constraints: true, odometry: false };
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

  show(scene) {
    this.scene = scene;
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
    this.content.replaceChildren(...this[`_${name}`]());
  }

  showCell(cell) {
    this.wasAsked = true;
    this.found = cell;
    this.open("cell");
  }

  showSubmap(name) {
    this.open("submaps");
    const card = this.content.querySelector(`[data-name="${CSS.escape(name)}"]`);
    if (card) card.scrollIntoView({ block: "center" });
  }

  showDecision(number) {
    this.open("decisions");
    const card = this.content.querySelector(`[data-number="${number}"]`);
    if (card) card.scrollIntoView({ block: "center" });
  }

  _vehicles() {
    const choices = Object.entries(LAYERS).map(([name, label]) => {
      const box = element("input", { type: "checkbox", checked: this.layers[name], onchange: () => { this.layers[name] = box.checked; this.actions.toggle(name, box.checked); } });
      return element("label", {}, box, ` ${label}`);
    });
    const cards = this.scene.vehicles.map((vehicle, index) => {
      const swatch = element("span", { className: "swatch" });
      swatch.style.background = style_of(index).color;
      const isMerged = vehicle.num_merged > 0;
      const age = (this.status.ages || {})[vehicle.name];
      const isOut = vehicle.num_withdrawn === vehicle.num_submaps;
      const run = { source: vehicle.id, is_run: true };
      const tools = element("div", { className: "tools" }, this.hand.button(isOut ? "restore the run" : "withdraw the run", { kind: isOut ? "restore" : "withdraw", ...run }));
      const card = element("button", { className: "card", onclick: () => this.actions.zoom(vehicle.name) },
        swatch, element("b", {}, vehicle.name), " ",
        element("span", { className: `chip ${isMerged ? "good" : ""}` }, isMerged ? "merged" : "by itself"),
        element("small", {}, `${vehicle.num_merged} of ${vehicle.num_submaps} submaps in the map${age === undefined ? "" : `, last message ${age.toFixed(0)} s ago`}`),
        element("small", {}, vehicle.reason));
      return element("div", {}, card, tools);
    });
    const notes = (this.status.notes || []).map((note) => element("p", { className: "card" }, note));
    return [element("fieldset", {}, ...choices), ...cards, ...notes];
  }

  _matches() {
    const edges = this.scene.constraints.filter((edge) => edge.kind === "registration");
    const rows = [...this.scene.registrations].sort((a, b) => Number(b.is_used) - Number(a.is_used) || b.probability - a.probability);
    const cards = rows.map((row) => element("button", { className: "card", onclick: () => this.actions.pair(row) },
      element("b", {}, `${row.source} in ${row.target}`), " ",
      element("span", { className: `chip ${row.is_used ? "good" : row.verdict === "ACCEPTED" ? "" : "off"}` }, row.is_used ? "holds" : row.verdict === "ACCEPTED" ? "taken out" : row.verdict),
      element("small", {}, row.reason)));
    const left = edges.map((edge) => element("p", { className: "card" }, told(edge)));
    return cards.length ? cards : left.length ? left : ["Nothing has been registered yet."];
  }

  _submaps() {
    return this.scene.submaps.map((submap) => {
      const card = element("div", { className: "card" }, element("b", {}, submap.name), " ",
        element("span", { className: `chip ${submap.state === "merged" ? "good" : "off"}` }, submap.state),
        element("small", {}, `revision ${submap.revision}, ${submap.is_final ? "closed" : "still growing"}, ${clock(submap.stamp_s)}`),
        element("small", {}, submap.reason));
      const isOut = submap.state === "withdrawn";
      const switched = this.hand.button(isOut ? "restore" : "withdraw", { kind: isOut ? "restore" : "withdraw", source: submap.id });
      const pin = this.hand.button("pin the frame here", { kind: "pin", source: submap.id });
      card.append(element("div", { className: "tools" }, switched, ...(isOut ? [] : [pin])), ...(isOut ? [] : [this.hand.fixForm(submap.id, [0, 0])]));
      card.dataset.name = submap.name;
      return card;
    });
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
    return [element("div", { className: "tools" }, lay), ...(earth ? [earth] : []), ...(cards.length ? cards : ["Nobody has decided anything yet."])];
  }

  _health() {
    const rows = this.status.diagnostics || [];
    if (!rows.length) return [this.status.is_live ? "No node has told of itself yet." : "This is a saved merge: no node runs."];
    const links = rows.filter((row) => row.sent_bytes !== undefined);
    const sent = links.map((row) => element("tr", {}, element("td", {}, row.name.split(":")[0]), element("td", {}, `${row.sent_bytes} bytes`), element("td", {}, row.bits_per_s === null ? "" : `${row.bits_per_s.toFixed(0)} bit/s`)));
    const cards = rows.map((row) => element("details", { className: "card", open: this.opened.has(row.name), ontoggle: (event) => this.opened[event.target.open ? "add" : "delete"](row.name) },
      element("summary", {}, element("b", {}, row.name.split(":")[0]), " ", element("span", { className: `chip ${row.level === "ok" ? "good" : ""}` }, row.level),
        element("small", {}, `${row.message}${row.age_s > 5 ? `, ${row.age_s.toFixed(0)} s ago` : ""}`)),
      element("table", {}, ...Object.entries(row.values).map(([key, value]) => element("tr", {}, element("th", { scope: "row" }, key), element("td", {}, value))))));
    return [...(links.length ? [element("h3", {}, "sent over the acoustic link"), element("table", {}, ...sent)] : []), ...cards];
  }

  _cell() {
    if (this.wasAsked && !this.found) return ["Nothing was seen here."];
    if (!this.found) return ["Click on the map to see which submaps saw a cell, and what they say of it."];
    const rows = Object.entries(this.found.percent).map(([name, percent]) => element("tr", {}, element("td", {}, name), element("td", {}, `${percent} %`), element("td", {}, percent > 50 ? "wall" : "free")));
    return [
      element("p", {}, `x ${this.found.x_m} m, y ${this.found.y_m} m`),
      element("p", {}, `${this.found.num_occupied} submaps say wall, ${this.found.num_free} say free`),
      element("table", {}, ...rows),
      this.hand.fixForm(...Object.values(this.found.points)[0]),
    ];
  }
}
