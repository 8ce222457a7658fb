"""Missions as files: a bag for each vehicle, and the truth in a folder of its own."""

from __future__ import annotations

import json
import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import OCCUPIED, OccupancyMap
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.recordings import BagWriter
from uw_dslam_ros2.io.trajectories import write_tum
from uw_dslam_ros2.sim.missions.mission import (
    T_BASE_SONAR,
    Mission,
    MissionConfig,
    PingMaker,
    VehicleRun,
    every_metre,
    plan_mission,
)
from uw_dslam_ros2.sim.missions.recorder import TRUTH_STEP, VehicleRecorder
from uw_dslam_ros2.sim.sonars.space_sonar import SpacePing
from uw_dslam_ros2.sim.waters.raster import grid_over, seen_map

__all__ = ["RecordedMission", "read_mission", "simulate_mission"]

_CHUNK_PINGS = 40
_CHUNK_BEAMS = 500
_PARTIAL = ".partial"

Ping = SonarImage | SpacePing
Progress = Callable[[int, int], None]
"""Called with pings done and pings in all."""


@dataclass(frozen=True, slots=True)
class RecordedMission:
    """Where the files of a mission are."""

    folder: Path
    vehicle_ids: tuple[str, ...]
    bags: tuple[Path, ...]
    truth_map: Path
    truth_trajectories: tuple[Path, ...]
    summary: dict[str, Any]


def simulate_mission(
    folder: str | Path,
    config: MissionConfig,
    *,
    storage: str = "mcap",
    num_processes: int = 1,
    progress: Progress | None = None,
) -> RecordedMission:
    """Simulate a mission and write it; the same configuration gives the same bytes.

    Writes ``<vehicle>/`` (a rosbag2 folder each), ``truth/map.yaml`` (what could be seen),
    ``truth/<vehicle>.tum``, ``truth/outline.json`` and ``mission.json``.

    All is written to a folder ``.partial`` inside and moved at the end, so that an interrupted run
    leaves no half a mission; the next run begins anew.

    Parameters
    ----------
    folder : must not hold a mission yet; made if it is missing.
    num_processes : how many processes make the images; the result does not depend on it.

    Raises
    ------
    DataError
        If the folder holds a mission already or cannot be written.
    """
    folder = Path(folder)
    if (folder / "mission.json").exists():
        raise DataError(f"{folder} holds a mission already; give another folder or remove it")
    partial = folder / _PARTIAL
    try:
        if partial.exists():  # of a run that was killed
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
        _record(partial, config, storage, num_processes, progress)
        # The description comes last: it says that the rest is there.
        for path in sorted(partial.iterdir(), key=lambda p: (p.name == "mission.json", p.name)):
            target = folder / path.name
            if target.is_dir():
                shutil.rmtree(target)
            path.rename(target)
    except OSError as error:
        raise DataError(f"{folder} cannot be written: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return read_mission(folder)


def _record(
    folder: Path,
    config: MissionConfig,
    storage: str,
    num_processes: int,
    progress: Progress | None,
) -> None:
    mission = plan_mission(config)
    total = sum(run.num_pings for run in mission.runs)
    done = 0
    with _ping_source(mission, num_processes) as images:
        for vehicle, run in enumerate(mission.runs):
            with BagWriter(folder / run.vehicle_id, storage) as writer:
                recorder = VehicleRecorder(writer, run, mission)
                for image in images(vehicle, run.num_pings):
                    recorder.write_until(image.stamp_ns)
                    recorder.write_ping(image)
                    done += 1
                    if progress is not None:
                        progress(done, total)
                recorder.write_until(None)
    _write_truth(folder / "truth", mission)


ImageSource = Callable[[int, int], Iterator[Ping]]


class _ping_source:  # noqa: N801 - used like a function
    """Context that gives ``images(vehicle, count)``: vehicle by vehicle, in order."""

    def __init__(self, mission: Mission, num_processes: int) -> None:
        self._mission = mission
        self._num_processes = num_processes
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> ImageSource:
        if self._num_processes <= 1:
            maker = PingMaker(self._mission)
            return lambda vehicle, count: maker.pings(vehicle, range(count))
        self._pool = ProcessPoolExecutor(
            self._num_processes,
            # A fresh interpreter: forking a process with threads (numba, pytest) is not safe.
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(self._mission.config,),
        )
        size = _CHUNK_BEAMS if self._mission.config.is_turning else _CHUNK_PINGS
        chunks = {
            vehicle: [
                self._pool.submit(_make_chunk, vehicle, start, min(start + size, count))
                for start in range(0, count, size)
            ]
            for vehicle, count in enumerate(run.num_pings for run in self._mission.runs)
        }

        def images(vehicle: int, _count: int) -> Iterator[Ping]:
            futures = chunks.pop(vehicle)
            while futures:
                yield from futures.pop(0).result()

        return images

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


_worker: list[PingMaker] = []


def _start_worker(config: MissionConfig) -> None:
    # The place is cheaper to plan again than to send.
    _worker.append(PingMaker(plan_mission(config)))


def _make_chunk(vehicle: int, start: int, stop: int) -> list[Ping]:
    return list(_worker[0].pings(vehicle, range(start, stop)))


def _write_truth(folder: Path, mission: Mission) -> None:
    """Everything that a recording of the real world would not have, and `mission.json`."""
    config, world = mission.config, mission.world
    spec = grid_over(world, config.truth_resolution_m)
    seen = [seen_map(world, spec, every_metre(run), *config.field_of_view) for run in mission.runs]
    values = np.stack([m.values for m in seen]).max(axis=0).astype(np.int8)
    write_map(folder / "map", OccupancyMap(spec, values))
    for run in mission.runs:
        motion = run.motion
        write_tum(
            folder / f"{run.vehicle_id}.tum",
            motion.stamp_ns[::TRUTH_STEP],
            motion.poses[::TRUTH_STEP],
        )
    outline = {
        "frame": "map",
        "segments_m": np.round(world.segments, 4).tolist(),
        "surface": [world.surfaces[i].name for i in world.surface_of],
    }
    (folder / "outline.json").write_text(json.dumps(outline) + "\n")
    summary = {
        "config": config.to_dict(),
        "vehicles": [_vehicle_summary(run) for run in mission.runs],
        "overlap_of_seen_walls": _overlaps(seen),
        "T_base_sonar": T_BASE_SONAR.as_array().tolist(),
        "truth_map": "truth/map.yaml",
    }
    (folder.parent / "mission.json").write_text(json.dumps(summary, indent=1) + "\n")


def _vehicle_summary(run: VehicleRun) -> dict[str, Any]:
    steps = np.hypot(*np.diff(run.motion.poses[:, :2], axis=0).T)
    start = run.motion.pose(0)
    return {
        "vehicle_id": run.vehicle_id,
        "bag": run.vehicle_id,
        "truth_trajectory": f"truth/{run.vehicle_id}.tum",
        "T_map_start": [start.x, start.y, start.yaw],
        "start_ns": int(run.motion.stamp_ns[0]),
        "stop_ns": int(run.motion.stamp_ns[-1]),
        "path_length_m": round(float(steps.sum()), 2),
        "num_pings": run.num_pings,
        "sonar_range_scale": run.range_scale,
        "sonar_yaw_error_rad": run.T_base_sonar.yaw - T_BASE_SONAR.yaw,
    }


def _overlaps(seen: list[OccupancyMap]) -> list[list[float]]:
    """Entry [i][j]: the part of the walls seen by vehicle i that vehicle j saw too."""
    walls = [m.values == OCCUPIED for m in seen]
    return [[round(float((a & b).sum() / max(1, a.sum())), 3) for b in walls] for a in walls]


def read_mission(folder: str | Path) -> RecordedMission:
    """Find the files of a mission that was simulated before.

    Raises
    ------
    DataError
        If there is no readable ``mission.json``, or a file that it names is missing.
    """
    folder = Path(folder)
    path = folder / "mission.json"
    try:
        summary = json.loads(path.read_text())
        vehicles = summary["vehicles"]
        recorded = RecordedMission(
            folder=folder,
            vehicle_ids=tuple(v["vehicle_id"] for v in vehicles),
            bags=tuple(folder / v["bag"] for v in vehicles),
            truth_map=folder / summary["truth_map"],
            truth_trajectories=tuple(folder / v["truth_trajectory"] for v in vehicles),
            summary=summary,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is not a mission's description: {error}") from error
    for file in (*recorded.bags, recorded.truth_map, *recorded.truth_trajectories):
        if not file.exists():
            raise DataError(f"{path} names {file}, which does not exist")
    return recorded
