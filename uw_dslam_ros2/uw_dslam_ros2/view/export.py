"""What is shown, as files for other programs, in one archive."""

from __future__ import annotations

import functools
import io
import json
import tempfile
import zipfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.core.chart.lines import trace_walls
from uw_dslam_ros2.core.merging import DecisionKind, SubmapRecord, SubmapState, last_seen_ns
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.earth import geotiff_bytes, projection_bytes, world_file_bytes
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.maps.walls import dxf_bytes, walls_geojson_bytes
from uw_dslam_ros2.io.pose_graphs import pose_graph_bytes
from uw_dslam_ros2.io.trajectories import tum_bytes
from uw_dslam_ros2.view.overview import Names
from uw_dslam_ros2.view.showing import Showing

__all__ = ["export_zip"]

_FIRST_TIME = (1980, 1, 1, 0, 0, 0)  # the same state gives the same bytes
_README = """\
Each folder holds one group of vehicles that share a frame; lengths are metres.
map.yaml, map.pgm   as nav2's map_server reads them
map.tif             GeoTIFF for GIS programs: per cent occupied, 255 where nothing is known
map.png, map.pgw    a picture and its world file, for the same
georeference.json   where there are fixes: where the map lies on earth; map.tif and map.pgw are
                    then in the coordinates that it names, and map.prj describes them, if UTM
walls.*             walls as lines, for GIS programs and for drawing programs
tracks.geojson      the vehicles' tracks; coordinates are metres of the group's frame
*.tum               the tracks with times: seconds x y z qx qy qz qw
graph.g2o           the pose graph, without edges that were found wrong
"""


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
        ages = functools.partial(last_seen_ns, occupancy.spec, records)
        walls, piers = trace_walls(occupancy, ages)
        files["walls.geojson"] = walls_geojson_bytes(walls, piers)
        files["walls.dxf"] = dxf_bytes(walls, piers)
        frame, T_earth_map = "metres of the map", SE2()
        if group == 0 and showing.georeference is not None:
            frame, T_earth_map = showing.georeference
            files |= _on_earth(showing, frame, T_earth_map)
        files["map.pgw"] = world_file_bytes(occupancy.spec, T_earth_map)
        files["map.tif"] = geotiff_bytes(occupancy, T_earth_map, frame)
    tracks = _tracks(records, showing.names)
    for name, (stamps_ns, poses) in tracks.items():
        files[f"{_plain(name)}.tum"] = tum_bytes(stamps_ns, poses)
    files["tracks.geojson"] = _geojson(tracks)
    files["graph.g2o"] = pose_graph_bytes(
        (r for r in showing.records if r.component == group), showing.constraints
    )
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
    if (projection := projection_bytes(frame)) is not None:
        files["map.prj"] = projection
    return files


def _plain(name: str) -> str:
    """A name that stays in its folder on every system."""
    return "".join(c if c.isalnum() or c in "-_#" else "_" for c in name)[:80] or "_"
