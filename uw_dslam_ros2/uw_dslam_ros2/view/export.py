"""What is shown, as files for other programs, in one archive."""

from __future__ import annotations

import io
import json
import re
import tempfile
import zipfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.core.chart.lines import trace_walls
from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging import DecisionKind, SubmapRecord, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps import write_map
from uw_dslam_ros2.io.trajectories import PoseGraphEdge, g2o_bytes, invertible, tum_bytes
from uw_dslam_ros2.io.wall_files import dxf_bytes, walls_geojson_bytes
from uw_dslam_ros2.view.overview import Names
from uw_dslam_ros2.view.showing import Showing

__all__ = ["export_zip"]

_FIRST_TIME = (1980, 1, 1, 0, 0, 0)  # the same state gives the same bytes
_README = """\
Each folder holds one group of vehicles that share a frame; lengths are metres.
map.yaml, map.pgm   as nav2's map_server reads them
map.png, map.pgw    a picture and its world file, for GIS programs
georeference.json   where there are fixes: where the map lies on earth; map.pgw is then in the
                    coordinates that it names, and map.prj describes them, if they are UTM
walls.*             walls as lines, for GIS programs and for drawing programs
tracks.geojson      the vehicles' tracks; coordinates are metres of the group's frame
*.tum               the tracks with times: seconds x y z qx qy qz qw
graph.g2o           the pose graph, without edges that were found wrong
"""

_UTM = re.compile(r"EPSG:32([67])(\d\d)")
_UTM_WKT = (
    'PROJCS["WGS 84 / UTM zone {name}",GEOGCS["WGS 84",DATUM["WGS_1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",{meridian}],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",{northing}],UNIT["metre",1]]'
)


def export_zip(showing: Showing) -> bytes:
    """An archive (zip) of maps, tracks and pose graphs of all groups."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:

        def add(name: str, content: bytes) -> None:
            archive.writestr(zipfile.ZipInfo(name, _FIRST_TIME), content, zipfile.ZIP_DEFLATED)

        add("README.txt", _README.encode())
        for group, records in sorted(_by_group(showing).items()):
            folder = "map" if group == 0 else f"group_{group}"
            for name, content in _files(showing, group, records).items():
                add(f"{folder}/{name}", content)
    return buffer.getvalue()


def _by_group(showing: Showing) -> dict[int, list[SubmapRecord]]:
    groups: dict[int, list[SubmapRecord]] = defaultdict(list)
    for record in showing.records:
        if record.state is not SubmapState.WITHDRAWN:
            groups[record.component].append(record)
    return groups


def _files(showing: Showing, group: int, records: list[SubmapRecord]) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    occupancy = showing.map_of(group)
    if occupancy is not None:
        with tempfile.TemporaryDirectory() as folder:
            for path in write_map(Path(folder) / "map", occupancy):
                files[path.name] = path.read_bytes()
        spec = occupancy.spec
        walls, piers = trace_walls(occupancy)
        files["walls.geojson"] = walls_geojson_bytes(walls, piers)
        files["walls.dxf"] = dxf_bytes(walls, piers)
        T_earth_map = SE2()
        if group == 0 and showing.georeference is not None:
            T_earth_map = showing.georeference[1]
            files |= _on_earth(showing, *showing.georeference)
        files["map.pgw"] = _world_file(spec, T_earth_map)
    tracks = _tracks(records, showing.names)
    for name, (stamps_ns, poses) in tracks.items():
        files[f"{_plain(name)}.tum"] = tum_bytes(stamps_ns, poses)
    files["tracks.geojson"] = _geojson(tracks)
    keys = {record.submap.submap_id: index for index, record in enumerate(records)}
    vertices = {keys[r.submap.submap_id]: r.T_component_submap for r in records}
    edges = [
        PoseGraphEdge(
            keys[c.target],
            keys[c.source],
            c.T_target_source,
            invertible(c.covariance),
        )
        for c in showing.constraints
        if c.is_inlier and c.source in keys and c.target in keys
    ]
    files["graph.g2o"] = g2o_bytes(vertices, edges)
    return files


def _tracks(records: list[SubmapRecord], names: Names) -> dict[str, tuple[Any, Any]]:
    pieces: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
    for record in records:
        submap = record.submap
        if len(submap.trajectory):
            motion = record.T_component_submap
            poses = np.column_stack(
                [
                    motion.apply(submap.trajectory[:, :2]),
                    submap.trajectory[:, 2] + motion.yaw,
                ]
            )
            name = names.track(submap.submap_id.track)
            pieces[name].append((submap.trajectory_stamp_ns, poses))
    tracks = {}
    for name, parts in sorted(pieces.items()):
        stamps_ns = np.concatenate([part[0] for part in parts])
        order = np.argsort(stamps_ns, kind="stable")
        tracks[name] = stamps_ns[order], np.concatenate([part[1] for part in parts])[order]
    return tracks


def _geojson(tracks: dict[str, tuple[Any, Any]]) -> bytes:
    features = [
        {
            "type": "Feature",
            "properties": {"vehicle": name},
            "geometry": {"type": "LineString", "coordinates": poses[:, :2].round(3).tolist()},
        }
        for name, (_, poses) in tracks.items()
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()


def _world_file(spec: GridSpec, T_earth_map: SE2) -> bytes:
    """Six numbers: what a step right and a step down are, and where the first pixel lies."""
    yaw = T_earth_map.yaw + spec.T_frame_grid.yaw
    c, s = spec.resolution_m * np.cos(yaw), spec.resolution_m * np.sin(yaw)
    # The middle of the picture's first cell, which is that of the last row.
    x_m, y_m = T_earth_map.apply(spec.centers_of(np.array([[spec.num_rows - 1, 0]])))[0]
    return "".join(f"{value:.9f}\n" for value in (c, s, s, -c, x_m, y_m)).encode()


def _on_earth(showing: Showing, frame: str, T_earth_map: SE2) -> dict[str, bytes]:
    """Where the map lies, and by what fixes."""
    told = {
        "frame": frame,
        "T_earth_map": T_earth_map.as_array().tolist(),
        "fixes": [
            {"who": r.decision.who, "stamp_ns": r.decision.stamp_ns, "remark": r.remark}
            for r in showing.decisions
            if r.is_in_force and r.decision.kind is DecisionKind.FIX
        ],
    }
    files = {"georeference.json": json.dumps(told, indent=1).encode()}
    zone = _UTM.fullmatch(frame)
    if zone is not None and 1 <= int(zone[2]) <= 60:
        is_south = zone[1] == "7"
        files["map.prj"] = _UTM_WKT.format(
            name=f"{int(zone[2])}{'S' if is_south else 'N'}",
            meridian=6 * int(zone[2]) - 183,
            northing=10_000_000 if is_south else 0,
        ).encode()
    return files


def _plain(name: str) -> str:
    """A name that stays in its folder on every system."""
    return "".join(c if c.isalnum() or c in "-_#" else "_" for c in name)[:80] or "_"
