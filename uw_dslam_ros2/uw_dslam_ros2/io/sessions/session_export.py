"""A queue as files for other programs."""

from __future__ import annotations

import hashlib
from pathlib import Path
from urllib.parse import quote

from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.maps.provenance import write_provenance
from uw_dslam_ros2.io.pose_graphs import pose_graph_bytes
from uw_dslam_ros2.io.trajectories import write_tum

__all__ = ["export_queue"]

_MAX_NAME = 80


def export_queue(folder: str | Path, queue: MapQueue) -> list[Path]:
    """Write a queue for other programs; missing folders are made.

    ``map.{yaml,pgm,png}`` (global map), ``map_contradictions.png`` and ``map_provenance.npz`` (who
    saw what, see `write_provenance`), ``submaps/<vehicle>_<sequence>.*`` (each in its own frame;
    of a second run ``<vehicle>_run2_<sequence>.*``), ``trajectories/<vehicle>.tum`` (merged
    vehicles, in "map"), ``graph.g2o`` (the global component, without the edges found wrong).
    """
    folder = Path(folder)
    written: list[Path] = []
    occupancy = queue.global_map()
    if occupancy is not None:
        written += write_map(folder / "map", occupancy)
    provenance = queue.provenance()
    if provenance is not None:
        written += write_provenance(folder / "map", provenance)
    records = queue.submaps()
    names = RunNames(record.submap for record in records)
    for record in records:
        submap = record.submap
        run = names.file(submap.submap_id.track, _file_name(submap.vehicle_id))
        name = f"{run}_{submap.sequence:04d}"
        written += write_map(folder / "submaps" / name, submap.grid)
    for vehicle, (stamps_ns, poses) in queue.trajectories().items():
        path = folder / "trajectories" / f"{_file_name(vehicle)}.tum"
        path.parent.mkdir(parents=True, exist_ok=True)
        written.append(write_tum(path, stamps_ns, poses))
    joined = [record for record in records if record.component == 0]
    graph = {folder / "graph.g2o": pose_graph_bytes(joined, queue.constraints())}
    return [*written, *write_files(graph)]


def _file_name(vehicle_id: str) -> str:
    """Name for a vehicle's files: different for different vehicles, short, and in its folder."""
    # Percent signs come from quoting alone, hence mark what stands for more than itself.
    name = quote(vehicle_id, safe="")
    if name.startswith("."):
        name = f"%2E{name[1:]}"
    if len(name) > _MAX_NAME:
        name = (
            f"{name[:_MAX_NAME]}%{hashlib.blake2b(vehicle_id.encode(), digest_size=8).hexdigest()}"
        )
    return name or "%"
