// The map: tiles of cells, tracks, submaps and constraints.
/* global L */
import { ask, style_of } from "./api.js";
import { worded } from "./hand.js";

const MARKS = { confirm: "◆", forbid: "✕", pin: "⌂", fix: "✚" }; // what a person decided

const GOOD_M = 0.3; // a constraint that is left with more than this is drawn as one that pulls

export class MapView {
  constructor(target, onSelect, onCell) {
    this.onSelect = onSelect;
    this.map = L.map(target, {
      crs: L.CRS.Simple, // metres: a pixel is 2^-zoom of them
      minZoom: -8, maxZoom: 9, zoomSnap: 0.5, zoomDelta: 1, attributionControl: false, preferCanvas: true,
    });
    this.groups = {
      cells: L.layerGroup(), submaps: L.layerGroup(), tracks: L.layerGroup(),
      odometry: L.layerGroup(), constraints: L.layerGroup(), names: L.layerGroup(),
    };
    for (const name of ["cells", "tracks", "constraints", "names"]) this.groups[name].addTo(this.map);
    L.control.scale({ imperial: false, maxWidth: 140 }).addTo(this.map);
    const note = L.control({ position: "bottomright" });
    note.onAdd = () => (this.note = L.DomUtil.create("div", "scale-note"));
    note.addTo(this.map);
    window.uwView = this; // for who looks at the page from its console, and for its tests
    this.map.setView([0, 0], 3);
    this.map.on("click", (event) => onCell(event.latlng.lng, event.latlng.lat));
    this.map.on("mousemove", (event) => this.#tell(event.latlng));
    this.isFitted = false;
  }

  show(scene, moment) {
    // What was lit may not be there any more.
    if (this.lit && this.scene && this.scene.version !== scene.version) this.highlight([]);
    this.scene = scene;
    this.#cells(scene, moment);
    const visible = new Set(scene.moments.slice(0, moment).map((m) => m.submap));
    const order = new Map(scene.vehicles.map((vehicle, index) => [vehicle.name, style_of(index)]));
    for (const name of ["submaps", "tracks", "odometry", "constraints", "names"]) this.groups[name].clearLayers();
    for (const vehicle of scene.vehicles) {
      const { color, dash } = order.get(vehicle.name);
      for (const piece of vehicle.track.filter((p) => visible.has(p.submap))) {
        const line = L.polyline(piece.xy.map(swap), { color, weight: 2.5, dashArray: dash });
        line.bindTooltip(text(`${piece.submap}`), { sticky: true });
        line.addTo(this.groups.tracks);
      }
    }
    for (const submap of scene.submaps.filter((s) => visible.has(s.name))) {
      const { color } = order.get(submap.vehicle);
      const rim = L.polygon(submap.outline.map(swap), { color, weight: 1.5, fillOpacity: 0.06 });
      rim.bindTooltip(text(`${submap.name}: ${submap.state}`), { sticky: true });
      rim.on("click", (event) => { L.DomEvent.stop(event); this.onSelect("submap", submap.name); });
      rim.addTo(this.groups.submaps);
    }
    scene.constraints.forEach((edge, index) => {
      if (!visible.has(edge.source) || !visible.has(edge.target)) return;
      if (edge.kind === "odometry") {
        L.polyline(edge.line.map(swap), { color: "#55636f", weight: 1 }).addTo(this.groups.odometry);
        return;
      }
      const line = L.polyline(edge.line.map(swap), look(edge));
      line.bindTooltip(text(told(edge)), { sticky: true });
      line.on("click", (event) => { L.DomEvent.stop(event); this.onSelect("constraint", index); });
      line.addTo(this.groups.constraints);
    });
    for (const row of scene.decisions.filter((d) => d.is_in_force && d.at && MARKS[d.kind])) {
      const icon = L.divIcon({ className: "decided", iconSize: null, iconAnchor: [8, 9], html: text(MARKS[row.kind]) });
      const mark = L.marker(swap(row.at), { icon, keyboard: true, title: worded(row) });
      mark.on("click", () => this.onSelect("decision", row.number));
      mark.addTo(this.groups.constraints);
    }
    for (const group of scene.groups.length > 1 ? scene.groups : []) {
      const [x0, , x1, y1] = group.bounds;
      L.marker([y1, (x0 + x1) / 2], { interactive: false, icon: L.divIcon({ className: "scale-note", iconSize: null, html: text(`${group.frame}: ${group.vehicles.join(", ")}`) }) }).addTo(this.groups.names);
    }
    if (!this.isFitted && scene.groups.length) {
      this.fit(scene.groups.map((group) => group.bounds));
      this.isFitted = true;
    }
  }

  fit(boxes) {
    const corners = boxes.flatMap(([x0, y0, x1, y1]) => [[y0, x0], [y1, x1]]);
    if (corners.length) this.map.fitBounds(L.latLngBounds(corners), { padding: [20, 20], animate: false });
  }

  toggle(name, isOn) {
    if (isOn) this.groups[name].addTo(this.map);
    else this.groups[name].remove();
  }

  mark(x, y) {
    if (this.marker) this.marker.remove();
    this.marker = L.circleMarker([y, x], { radius: 6, color: "#cc2800", fill: false, weight: 2 }).addTo(this.map);
  }

  highlight(lines) {
    if (this.lit) this.lit.remove();
    this.lit = L.layerGroup(lines.map((line) => L.polyline(line.map(swap), { color: "#cc2800", weight: 5, opacity: 0.8 }))).addTo(this.map);
  }

  #cells(scene, moment) {
    const key = `${scene.version}/${moment === scene.moments.length ? "all" : moment}`;
    if (key === this.cellsKey) return;
    this.cellsKey = key;
    const old = this.tiles;
    this.tiles = L.tileLayer(`/api/tiles/${key}/{z}/{x}/{y}.png`, {
      minNativeZoom: -8, maxNativeZoom: 9, minZoom: -8, maxZoom: 9, noWrap: true, keepBuffer: 1, updateWhenZooming: false,
      errorTileUrl: "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==",
    });
    // The old picture goes when the new one is there: no flicker.
    this.tiles.once("load", () => old && old.remove());
    this.tiles.addTo(this.groups.cells);
  }

  #tell(place) {
    const inside = this.scene && this.scene.groups.find(({ bounds: [x0, y0, x1, y1] }) => place.lng >= x0 && place.lng <= x1 && place.lat >= y0 && place.lat <= y1);
    const [dx, dy] = inside ? inside.shift : [0, 0];
    this.note.textContent = inside ? `${inside.frame}  x ${(place.lng - dx).toFixed(2)} m  y ${(place.lat - dy).toFixed(2)} m` : "";
  }

  async cell(x, y) {
    this.mark(x, y);
    return ask(`/api/cell?x=${x}&y=${y}`);
  }
}

function swap([x, y]) {
  return [y, x]; // Leaflet's order
}

function text(value) {
  const span = document.createElement("span");
  span.textContent = value;
  return span;
}

function look(edge) {
  if (edge.kind === "confirmed") return { color: "#5b2a86", weight: 4, dashArray: "12 4 2 4" };
  if (!edge.is_inlier) return { color: "#cc2800", weight: 2, dashArray: "2 5" };
  if (edge.is_unsure) return { color: "#8a6d00", weight: 2.5, dashArray: "8 4" };
  return { color: edge.residual_m > GOOD_M ? "#d55e00" : "#00704f", weight: 2.5 };
}

export function told(edge) {
  const left = edge.residual_m === null ? "" : `, ${edge.residual_m.toFixed(2)} m and ${edge.residual_deg.toFixed(2)}° left`;
  const state = edge.kind === "confirmed" ? "confirmed by a person" : !edge.is_inlier ? "taken out: it contradicts the others" : edge.is_unsure ? "refused by itself, believed because others agree" : "holds";
  return `${edge.source} – ${edge.target}: ${state}${left}`;
}
