import { ask, clock, listen } from "./api.js";
import { Hand } from "./hand.js";
import { LayDialog } from "./lay.js";
import { MapView } from "./map.js";
import { PairDialog } from "./pair.js";
import { Panel } from "./panel.js";
import { Replay } from "./replay.js";

const at = (id) => document.getElementById(id);
const STATUS_MS = 2000;
let scene = null;
let isBusy = false;
let isStale = false;

const hand = new Hand(at("hand"), at("who"), at("said"));
const laying = new LayDialog(hand);
const lay = (runs, match) => laying.open(scene.vehicles.map((vehicle) => vehicle.name), runs, match);
const dialog = new PairDialog(hand, lay);
const panel = new Panel(at("tabs"), at("content"), {
  zoom: (name) => {
    const points = scene.vehicles.find((v) => v.name === name).track.flatMap((piece) => piece.xy);
    if (points.length) map.fit(points);
  },
  pair: (row) => {
    map.highlight(scene.constraints.filter((edge) => belongs(edge, row)).map((edge) => edge.line));
    dialog.open(row);
  },
  lay: () => lay(),
}, hand);
const map = new MapView("map", select, async (x, y) => panel.showCell(await map.cell(x, y)));
const replay = new Replay(at("play"), at("moment"), draw);

function belongs(edge, row) {
  return edge.kind === "registration" && row.submaps.includes(edge.source) && row.submaps.includes(edge.target);
}

function select(kind, which) {
  if (kind === "submap") {
    panel.showSubmap(which);
    return;
  }
  if (kind === "decision") {
    panel.showDecision(which);
    return;
  }
  const edge = scene.constraints[which];
  map.highlight([edge.line]);
  if (edge.kind === "confirmed") {
    panel.open("decisions");
    return;
  }
  // Of the answers about these two submaps, the one that holds and is of the fewest others.
  const rows = scene.registrations.filter((row) => belongs(edge, row));
  rows.sort((a, b) => Number(b.is_used) - Number(a.is_used) || a.submaps.length - b.submaps.length);
  if (rows.length) dialog.open(rows[0], edge);
  else panel.open("matches");
}

function draw() {
  if (!scene) return;
  const newest = replay.moment > 0 ? scene.moments[replay.moment - 1] : null;
  at("moment-text").textContent = newest ? `${clock(newest.stamp_s)} · ${replay.moment} of ${scene.moments.length} submaps` : "before the first submap";
  map.show(scene, replay.moment);
}

async function refresh() {
  if (isBusy) {
    isStale = true;
    return;
  }
  isBusy = true;
  try {
    const [next, status] = await Promise.all([ask("/api/scene"), ask("/api/status")]);
    scene = next;
    panel.status = status;
    replay.resize(scene.moments.length);
    at("title").textContent = scene.title;
    document.title = `${scene.title} – uw_dslam`;
    const merged = scene.vehicles.filter((vehicle) => vehicle.num_merged > 0).length;
    at("summary").textContent = `${merged} of ${scene.vehicles.length} vehicles merged, ${scene.submaps.length} submaps, ${scene.groups.length} ${scene.groups.length === 1 ? "group" : "groups that are not joined"}`;
    at("connection").textContent = "";
    panel.show(scene);
    draw();
  } catch (error) {
    at("connection").textContent = error.message;
  } finally {
    isBusy = false;
    if (isStale) {
      isStale = false;
      refresh();
    }
  }
}

// Ages, and what nodes tell of themselves, change without the map changing.
setInterval(async () => {
  if (!scene || !panel.status.is_live || !panel.showsStatus) return;
  panel.status = await ask("/api/status").catch(() => panel.status);
  panel.show(scene);
}, STATUS_MS);
listen(refresh, (isThere) => {
  at("connection").textContent = isThere ? "" : "the view is not there: what is shown may be old";
});
