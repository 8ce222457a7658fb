"""Three vehicles into one map: the queue against the paper's, with the engine, ICP and NDT.

Simulated missions by seed, each vehicle with an unknown start; their submaps are made once and
given to every method. "true poses" places each submap where it really was: no merging can expect
better. Of a vehicle that stayed apart the study tells the greatest share that any of its submaps
has, by the truth, in common with one that was joined. The pairwise queue is the paper's: two maps
are taken, registered, and the merged one is put back. ICP and NDT are started from many headings
and have no verdict, so the queue believes them. Errors are those of the largest group of vehicles
that was joined, in one common frame. With ``--data`` (or UW_DATA_DIR) the Aracati recording is
merged too, as three vehicles.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.reporting.outcome import Trajectory
from uw_dslam_ros2.cli.reporting.scoring import WALL_TOLERANCE_M
from uw_dslam_ros2.cli.studies._common import (
    ARACATI,
    COLOURS,
    add_aracati_arguments,
    aracati_settings,
    figure,
    optional_data_dir,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.cli.studies._fleet_missions import (
    FleetMission,
    mapped_bags,
    simulated_mission,
)
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, MatchRequest
from uw_dslam_ros2.core.metrics import (
    compare_maps,
    interpolate_poses,
    map_sharpness,
    trajectory_error,
)
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.registration import PriorWindow, RegistrationResult, register_grids
from uw_dslam_ros2.core.registration.baselines.icp import many_start_icp
from uw_dslam_ros2.core.registration.baselines.ndt import ndt
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.datasets.aracati2017 import read_aracati2017, write_bags
from uw_dslam_ros2.sim.maps.fleets import answer_all, known_overlap, make_result
from uw_dslam_ros2.sim.waters.places import PLACES

__all__ = ["add_arguments", "merged_largest", "placing_error", "run"]

FloatArray = NDArray[np.float64]
Placing = dict[SubmapId, SE2]
Matcher = Callable[[MatchRequest], RegistrationResult]

_TRUE = "true poses"
_LOG_ODDS_MAX = 8.0
_MAX_POINTS = 500
_NUM_HEADINGS = 24
_MAX_BOXES_OF_PAPER = 300_000  # its objective on maps' points hardly ever closes its gap
_NEAR = (2.0, np.radians(5.0))  # [m], [rad]: the window about the true pose
_SCORES = ("rmse_m", "rmse_deg", "mse", "ssim", "iou")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=10, help="simulated missions (0: none)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--duration", type=float, default=150.0, help="of each mission [s]")
    parser.add_argument("--place", choices=PLACES, default="harbour")
    parser.add_argument("--methods", nargs="*", choices=sorted(_methods()), metavar="METHOD",
                        help=f"default: all of {', '.join(_methods())}")  # fmt: skip
    add_aracati_arguments(parser)


@dataclass(frozen=True, slots=True)
class _Method:
    """A queue, and what answers it."""

    mode: str
    matcher: Matcher


def _methods() -> dict[str, _Method]:
    return {
        "ours": _Method("graph", _engine),
        "pairwise, engine": _Method("pairwise", _engine),
        "pairwise, paper's GMRBnB": _Method("pairwise", _paper),
        "pairwise, ICP": _Method("pairwise", _icp),
        "pairwise, NDT": _Method("pairwise", _ndt),
    }


def run(args: argparse.Namespace) -> int:
    """Merge every mission by every method; write ``merging.png`` and ``merging.csv``."""
    methods = {n: m for n, m in _methods().items() if not args.methods or n in args.methods}
    rows: list[dict[str, Any]] = []
    for mission in _missions(args):
        rows.append(_row(mission, _TRUE, _true_placing(mission), 0, 0.0))
        for name, method in methods.items():
            placing, num_searches, cpu_s = _merged(mission, method)
            rows.append(_row(mission, name, placing, num_searches, cpu_s))
        own = [row for row in rows if row["mission"] == mission.name]
        print(f"{mission.name}: " + ", ".join(_short(row) for row in own), flush=True)
    if not rows:
        raise DataError("nothing to merge: give --seeds or --data")
    write_csv(args.out / "merging.csv", rows)
    _draw(rows, args.out / "merging.png")
    _report(rows)
    return 0


def _short(row: dict[str, Any]) -> str:
    text = f"{row['method']} {row['rmse_m']:.2f} m ({row['vehicles']} of {row['of']}"
    return f"{text}; apart: {row['apart']})" if row["apart"] else f"{text})"


def _missions(args: argparse.Namespace) -> Iterator[FleetMission]:
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for seed in progress(seeds, text="missions"):
        yield simulated_mission(seed, args.vehicles, args.duration, args.place, args.out / "cache")
    folder = optional_data_dir(args.data, ARACATI)
    if folder is None:
        return
    with TemporaryDirectory() as work:
        write_bags(read_aracati2017(folder), Path(work))
        bags = tuple(Path(work) / f"auv_{number}" for number in (1, 2, 3))
        yield mapped_bags(
            ARACATI,
            bags,
            Path(work) / "truth",
            aracati_settings(args),
        )


# --- matchers --------------------------------------------------------------------------------


def _engine(request: MatchRequest) -> RegistrationResult:
    return register_grids(request.source, request.target, prior=request.prior)


def _paper(request: MatchRequest) -> RegistrationResult:
    config = GridRegistrationConfig(method="paper", max_boxes=_MAX_BOXES_OF_PAPER)
    return register_grids(request.source, request.target, config, prior=request.prior)


def _icp(request: MatchRequest) -> RegistrationResult:
    source, target = _walls(request.source), _walls(request.target)
    found = many_start_icp(
        source, target, num_starts=_NUM_HEADINGS, first_cutoff_m=10.0, last_cutoff_m=0.5
    )
    return _believed(found.T_target_source)


def _ndt(request: MatchRequest) -> RegistrationResult:
    source, target = _walls(request.source), _walls(request.target)
    to_source, to_target = source.mean(axis=0), target.mean(axis=0)
    best: tuple[float, SE2 | None] = (-np.inf, None)
    for yaw in np.linspace(-np.pi, np.pi, _NUM_HEADINGS, endpoint=False):
        turn = SE2.from_array(np.append(to_target, yaw))
        start = turn @ SE2.from_array(np.append(-to_source, 0.0))
        found = ndt(source, target, T_initial=start, cell_m=2.0, max_iterations=25)
        if found.T_target_source is not None and found.score > best[0]:
            best = found.score, found.T_target_source
    return _believed(best[1])


def _walls(occupancy: OccupancyMap) -> FloatArray:
    cells = np.argwhere(occupancy.values > 50)
    step = max(1, -(-len(cells) // _MAX_POINTS))
    # In no particular order, or the thinning would take rows.
    order = np.random.default_rng(0).permutation(len(cells))
    return occupancy.spec.centers_of(cells[order[::step]])


def _believed(motion: SE2 | None) -> RegistrationResult:
    if motion is None:
        return RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "nothing found")
    return make_result(motion)


# --- merging and scores ----------------------------------------------------------------------


def _merged(mission: FleetMission, method: _Method) -> tuple[Placing, int, float]:
    """Poses of the largest group that was joined, number of registrations, CPU time of all."""
    begun_s = time.process_time()
    queue = MapQueue(MapQueueConfig(mode=method.mode))
    for submap in mission.submaps:
        queue.add_submap(submap)
    num_searches = answer_all(queue, method.matcher)
    return _largest(queue), num_searches, time.process_time() - begun_s


def _largest(queue: MapQueue) -> Placing:
    groups: dict[int, Placing] = {}
    for record in queue.submaps():
        groups.setdefault(record.component, {})[record.submap.submap_id] = (
            record.T_component_submap
        )
    return max(groups.values(), key=len)


def merged_largest(
    mission: FleetMission, match: Callable[[MatchRequest], RegistrationResult] = _engine
) -> tuple[Placing, set[SubmapId]]:
    """Largest group of submaps that are joined: their poses, and who was matched."""
    queue = MapQueue()
    for submap in mission.submaps:
        queue.add_submap(submap)
    answer_all(queue, match)
    matched = {
        submap_id
        for answer, is_used in queue.answers()
        for submap_id in (*answer.query.source.ids, *answer.query.target.ids)
        if is_used and answer.query.prior is not None
    }
    return _largest(queue), matched


def placing_error(mission: FleetMission, placing: Placing) -> float:
    """RMSE [m] of the trajectories of placed submaps."""
    submaps = [submap for submap in mission.submaps if submap.submap_id in placing]
    paths = _trajectories(submaps, placing)
    return float(trajectory_error(paths, mission.truth.trajectories).rmse_m)


def _true_placing(mission: FleetMission) -> Placing:
    placing: Placing = {}
    for submap in mission.submaps:
        truth = mission.truth.trajectories[submap.vehicle_id]
        poses, is_known = interpolate_poses(truth, submap.trajectory_stamp_ns)
        index = int(np.argmax(is_known))
        if is_known.any():
            T_submap_base = SE2.from_array(submap.trajectory[index])
            placing[submap.submap_id] = SE2.from_array(poses[index]) @ T_submap_base.inverse()
    return placing


def _row(
    mission: FleetMission, method: str, placing: Placing, num_searches: int, cpu_s: float
) -> dict[str, Any]:
    submaps = [submap for submap in mission.submaps if submap.submap_id in placing]
    error = trajectory_error(_trajectories(submaps, placing), mission.truth.trajectories)
    fused = _fused(submaps, placing)
    row = {
        "mission": mission.name,
        "method": method,
        "vehicles": len({submap.vehicle_id for submap in submaps}),
        "of": len({submap.vehicle_id for submap in mission.submaps}),
        "rmse_m": round(error.rmse_m, 4),
        "rmse_deg": round(float(np.degrees(error.rmse_rad)), 3),
        "mse": "",
        "ssim": "",
        "iou": "",
        "wall_share": round(map_sharpness(fused).wall_share, 5),
        "apart": _apart(mission, placing),
        "registrations": num_searches,
        "cpu_s": round(cpu_s, 1),
    }
    if mission.truth.map is not None:
        scores = compare_maps(
            fused, mission.truth.map, error.T_truth_map, tolerance_m=WALL_TOLERANCE_M
        )
        row |= {
            "mse": round(scores.mse, 5),
            "ssim": round(scores.ssim, 4),
            "iou": round(scores.wall_iou_tolerant, 4),
        }
    return row


def _apart(mission: FleetMission, placing: Placing) -> str:
    """Who is not in a group; what there was in common, by the truth, and could it be told.

    Seen area says little: two vehicles may see one stretch of water and walls on either side of
    it. So the walls in common are told as well, and the verdict on a search that begins at the
    true pose.
    """
    truth = _true_placing(mission)
    joined = {submap_id[0] for submap_id in placing}
    others = _fused([s for s in mission.submaps if s.submap_id in placing], truth)
    told = []
    for name in sorted({submap_id[0] for submap_id in truth} - joined):
        own = _fused([s for s in mission.submaps if s.vehicle_id == name], truth)
        area = known_overlap(own, others, SE2(0.0, 0.0, 0.0))
        walls = compare_maps(own, others, tolerance_m=WALL_TOLERANCE_M).wall_precision
        near = register_grids(own, others, prior=PriorWindow(SE2(0.0, 0.0, 0.0), *_NEAR))
        told.append(
            f"{name} has {area:.0%} of the area and {walls:.0%} of its walls in common, "
            f"asked near the truth {near.verdict.name} at {near.probability:.2f}"
        )
    return "; ".join(told)


def _trajectories(submaps: list[Submap], placing: Placing) -> Mapping[str, Trajectory]:
    parts: dict[str, dict[int, FloatArray]] = {}
    for submap in submaps:
        own = parts.setdefault(submap.vehicle_id, {})
        for stamp_ns, pose in zip(submap.trajectory_stamp_ns, submap.trajectory, strict=True):
            own[int(stamp_ns)] = (placing[submap.submap_id] @ SE2.from_array(pose)).as_array()
    return {
        vehicle: (np.array(sorted(own)), np.array([own[stamp] for stamp in sorted(own)]))
        for vehicle, own in parts.items()
    }


def _fused(submaps: list[Submap], placing: Placing) -> OccupancyMap:
    lattice = GridSpec(submaps[0].grid.spec.resolution_m, 1, 1)
    placed = [(submap.grid, placing[submap.submap_id]) for submap in submaps]
    fused = fuse_maps(lattice, placed, _LOG_ODDS_MAX)
    assert fused is not None, "submaps hold something"
    return fused


# --- pictures and tables ---------------------------------------------------------------------


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    simulated = [row for row in rows if row["ssim"] != ""]
    if not simulated:
        return
    names = list(dict.fromkeys(row["method"] for row in simulated))
    made, axes = figure(1, 3, width=11.0, height=3.6)
    labels = {"rmse_m": "trajectory error [m]", "ssim": "SSIM", "iou": "IoU of walls"}
    for axis, (score, label) in zip(axes[0], labels.items(), strict=True):
        for place, (name, colour) in enumerate(zip(names, COLOURS, strict=False)):
            values = [row[score] for row in simulated if row["method"] == name]
            axis.plot([place] * len(values), values, "o", ms=4, alpha=0.6, color=colour)
            axis.plot([place - 0.3, place + 0.3], [np.median(values)] * 2, color=colour)
        axis.set_ylabel(label)
        axis.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes[0, 0].set_yscale("log")
    save_figure(made, path)


def _report(rows: list[dict[str, Any]]) -> None:
    header = ["case", "method", "all merged", "RMSE m (median, worst)", "deg", "MSE", "SSIM",
              "IoU", "registrations", "CPU s"]  # fmt: skip
    table = []
    for is_simulated in (True, False):
        chosen = [row for row in rows if (row["ssim"] != "") is is_simulated]
        for name in dict.fromkeys(row["method"] for row in chosen):
            own = [row for row in chosen if row["method"] == name]
            num_whole = sum(row["vehicles"] == row["of"] for row in own)
            medians = [
                f"{np.median([row[score] for row in own]):.3g}" if own[0][score] != "" else ""
                for score in _SCORES[1:]
            ]
            errors = [row["rmse_m"] for row in own]
            table.append(
                [
                    "simulated" if is_simulated else own[0]["mission"],
                    name,
                    f"{num_whole} of {len(own)}",
                    f"{np.median(errors):.3f}, {np.max(errors):.3f}",
                    *medians,
                    f"{np.mean([row['registrations'] for row in own]):.1f}",
                    f"{np.median([row['cpu_s'] for row in own]):.1f}",
                ]
            )
    print_table(header, table)
