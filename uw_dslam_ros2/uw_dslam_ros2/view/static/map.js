// The map: tiles of cells, tracks, submaps and constraints.
import { ask, style_of } from "./api.js";
import { kind_of, ODOMETRY, told } from "./edges.js";
import { worded } from "./hand.js";
import { Layers } from "./layers.js";

const MARKS = { confirm: "◆", forbid: "✕", pin: "⌂", fix: "✚" }; // what a person decided
const REST_MS = 250; // a mouse that rests so long asks of the cell below it
const MIN_ZOOM = -8;
const MAX_ZOOM = 9;
const BRIGHT = "#cc2800";

export class MapView {
  constructor(target, onSelect, onCell) {
    this.onSelect = onSelect;
    this.map = L.map(target, {
      crs: L.CRS.Simple, // metres: a pixel is 2^-zoom of them
      minZoom: MIN_ZOOM, maxZoom: MAX_ZOOM, zoomSnap: 0.25, zoomDelta: 1, attributionControl: false, preferCanvas: true,
    });
    this.groups = {
      cells: L.layerGroup(), submaps: L.layerGroup(), tracks: L.layerGroup(),
      odometry: L.layerGroup(), constraints: L.layerGroup(), names: L.layerGroup(),
    };
    for (const name of ["cells", "names"]) this.groups[name].addTo(this.map);
    L.control.scale({ imperial: false, maxWidth: 140 }).addTo(this.map);
    const note = L.control({ position: "bottomright" });
    note.onAdd = () => (this.note = L.DomUtil.create("div", "map-note"));
    note.addTo(this.map);
    this.layers = new Layers((name, isOn) => this.#toggle(name, isOn));
    this.layers.control.addTo(this.map);
    window.uwView = this; // for who looks at the page from its console, and for its tests
    this.map.setView([0, 0], 3);
    this.map.on("click", (event) => this.#ask(event.latlng, onCell));
    this.map.on("mousemove", (event) => this.#tell(event.latlng));
    this.map.on("movestart", () => this.#forget());
    this.map.getContainer().addEventListener("mouseleave", () => this.#forget()); // the map's own is any line's, too
    this.map.getContainer().addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target === this.map.getContainer()) this.#ask(this.map.getCenter(), onCell);
    });
    this.isFitted = false;
  }

  show(scene, moment) {
    // What was lit may not be there any more.
    if (this.lit && this.scene && this.scene.version !== scene.version) this.highlight([]);
    this.scene = scene;
    this.#cells(scene, moment);
    this.layers.show(scene);
    const visible = new Set(scene.moments.slice(0, moment).map((m) => m.submap));
    const order = new Map(scene.vehicles.map((vehicle, index) => [vehicle.name, style_of(index)]));
    for (const name of ["submaps", "tracks", "odometry", "constraints", "names"]) this.groups[name].clearLayers();
    for (const vehicle of scene.vehicles) this.#track(vehicle, order.get(vehicle.name), visible);
    for (const submap of scene.submaps.filter((s) => visible.has(s.name))) {
      const { color } = order.get(submap.vehicle);
      const rim = L.polygon(submap.outline.map(swap), { color, weight: 1.5, fillOpacity: 0.06 });
      rim.bindTooltip(text(`${submap.name}: ${submap.state}`), { sticky: true });
      rim.on("click", (event) => { L.DomEvent.stop(event); this.onSelect("submap", submap.name); });
      rim.addTo(this.groups.submaps);
    }
    scene.constraints.forEach((edge, index) => {
      if (visible.has(edge.source) && visible.has(edge.target)) this.#edge(edge, index);
    });
    for (const row of scene.decisions.filter((d) => d.is_in_force && d.at && MARKS[d.kind])) {
      const icon = L.divIcon({ className: "decided", iconSize: null, iconAnchor: [8, 9], html: text(MARKS[row.kind]) });
      const mark = L.marker(swap(row.at), { icon, keyboard: true, title: worded(row) });
      mark.on("click", () => this.onSelect("decision", row.number));
      mark.addTo(this.groups.constraints);
    }
    for (const group of scene.groups.length > 1 ? scene.groups : []) {
      const [x0, , , y1] = group.bounds;
      const icon = L.divIcon({ className: "map-note group-name", iconSize: null, iconAnchor: [0, 26], html: text(`${group.frame}: ${group.vehicles.join(", ")}`) });
      L.marker([y1, x0], { interactive: false, keyboard: false, icon }).addTo(this.groups.names);
    }
    if (!this.isFitted && scene.groups.length) {
      const seen = scene.submaps.flatMap((submap) => submap.outline);
      this.fit(seen.length ? seen : scene.groups.flatMap(({ bounds: [x0, y0, x1, y1] }) => [[x0, y0], [x1, y1]]));
      this.isFitted = true;
    }
  }

  fit(points) {
    this.map.fitBounds(L.latLngBounds(points.map(swap)), { padding: [24, 24], animate: false });
  }

  mark(x, y) {
    if (this.marker) this.marker.remove();
    this.marker = L.circleMarker([y, x], { radius: 6, color: BRIGHT, fill: false, weight: 2 }).addTo(this.map);
  }

  highlight(lines) {
    if (this.lit) this.lit.remove();
    this.lit = L.layerGroup(lines.map((line) => L.polyline(line.map(swap), { color: BRIGHT, weight: 5, opacity: 0.8, interactive: false }))).addTo(this.map);
  }

  async cell(x, y) {
    this.mark(x, y);
    return ask(`/api/cell?x=${x}&y=${y}`);
  }

  #toggle(name, isOn) {
    if (isOn) this.groups[name].addTo(this.map);
    else this.groups[name].remove();
  }

  /** A vehicle's way, with its name where it was last. */
  #track(vehicle, { color, dash }, visible) {
    const pieces = vehicle.track.filter((piece) => visible.has(piece.submap));
    for (const piece of pieces) {
      const line = L.polyline(piece.xy.map(swap), { color, weight: 2.5, dashArray: dash });
      line.bindTooltip(text(piece.submap), { sticky: true });
      line.addTo(this.groups.tracks);
    }
    if (!pieces.length) return;
    const name = text(vehicle.name);
    name.style.background = color;
    const icon = L.divIcon({ className: "leaflet-div-icon vehicle-name", iconSize: null, iconAnchor: [-4, 9], html: name });
    L.marker(swap(pieces.at(-1).xy.at(-1)), { interactive: false, keyboard: false, icon }).addTo(this.groups.tracks);
  }

  #edge(edge, index) {
    const points = edge.line.map(swap);
    if (edge.kind === "odometry") {
      L.polyline(points, { ...ODOMETRY, interactive: false }).addTo(this.groups.odometry);
      return;
    }
    const { line: style } = kind_of(edge);
    // White below, and dots at the ends, so that it is not taken for a way.
    L.polyline(points, { color: "#fff", weight: style.weight + 3, opacity: 0.85, interactive: false }).addTo(this.groups.constraints);
    for (const point of points) {
      L.circleMarker(point, { radius: 4, color: "#fff", weight: 1.5, fillColor: style.color, fillOpacity: 1, interactive: false }).addTo(this.groups.constraints);
    }
    const line = L.polyline(points, style);
    line.bindTooltip(text(told(edge)), { sticky: true });
    line.on("click", (event) => { L.DomEvent.stop(event); this.onSelect("constraint", index); });
    line.addTo(this.groups.constraints);
  }

  #cells(scene, moment) {
    const key = `${scene.version}/${moment === scene.moments.length ? "all" : moment}`;
    if (key === this.cellsKey) return;
    this.cellsKey = key;
    const old = this.tiles;
    this.tiles = L.tileLayer(`/api/tiles/${key}/{z}/{x}/{y}.png`, {
      minNativeZoom: MIN_ZOOM, maxNativeZoom: MAX_ZOOM, minZoom: MIN_ZOOM, maxZoom: MAX_ZOOM, noWrap: true, keepBuffer: 1, updateWhenZooming: false,
      errorTileUrl: "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==",
    });
    // The old picture goes when the new one is there: no flicker.
    this.tiles.once("load", () => old && old.remove());
    this.tiles.addTo(this.groups.cells);
  }

  #ask(place, onCell) {
    clearTimeout(this.resting);
    onCell(place.lng, place.lat);
  }

  #forget() {
    clearTimeout(this.resting);
    this.note.textContent = "";
  }

  /** Where the mouse is; and once it rests, which submaps saw what there. */
  #tell(place) {
    clearTimeout(this.resting);
    const inside = this.scene && this.scene.groups.find(({ bounds: [x0, y0, x1, y1] }) => place.lng >= x0 && place.lng <= x1 && place.lat >= y0 && place.lat <= y1);
    this.note.textContent = "";
    if (!inside) return;
    const [dx, dy] = inside.shift;
    const where = `${inside.frame}  x ${(place.lng - dx).toFixed(2)} m  y ${(place.lat - dy).toFixed(2)} m`;
    this.note.textContent = where;
    this.resting = setTimeout(async () => {
      const cell = await ask(`/api/cell?x=${place.lng}&y=${place.lat}`).catch(() => null);
      if (cell && this.note.textContent === where) this.note.textContent = `${where} · ${seen_by(cell)}`;
    }, REST_MS);
  }
}

const MAX_NAMED = 3;

/** Who says what of a cell, in a line. */
function seen_by({ percent }) {
  const sides = [["wall", (value) => value > 50], ["free", (value) => value <= 50]].map(([word, says]) => {
    const names = Object.entries(percent).filter(([, value]) => says(value)).map(([name]) => name);
    const more = names.length > MAX_NAMED ? ` and ${names.length - MAX_NAMED} more` : "";
    return names.length ? `${word}: ${names.slice(0, MAX_NAMED).join(", ")}${more}` : "";
  });
  return sides.filter(Boolean).join(" · ");
}

function swap([x, y]) {
  return [y, x]; // Leaflet's order
}

function text(value) {
  const span = document.createElement("span");
  span.textContent = value;
  return span;
}
