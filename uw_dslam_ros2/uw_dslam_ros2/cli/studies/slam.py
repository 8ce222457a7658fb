"""One vehicle's map before and after SLAM: simulated missions and Aracati 2017, with the truth.

Each recording is mapped twice, by dead reckoning alone and with scan matching and loop closures.
Without ``--data`` (or UW_DATA_DIR) the real recording is left out, and the table says so.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    data_dir,
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.metrics import (
    TrajectoryError,
    compare_maps,
    interpolate_poses,
    trajectory_error,
)
from uw_dslam_ros2.core.mounting import StaticFrames
from uw_dslam_ros2.io.bags import TransformEvent, TruthEvent, read_events
from uw_dslam_ros2.io.datasets.aracati2017 import SEGMENTS, read_aracati2017, write_bag
from uw_dslam_ros2.io.feeding import feed
from uw_dslam_ros2.io.maps import read_map
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.sim.mission import MissionConfig
from uw_dslam_ros2.sim.places import PLACES
from uw_dslam_ros2.sim.recording import simulate_mission

__all__ = ["add_arguments", "run"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_ESTIMATORS = ("dead_reckoning", "scan_matching")
_TITLES = ("dead reckoning", "with SLAM")
_WALL_TOLERANCE_M = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """A recording and its truth."""

    name: str
    bag: Path
    config: VehicleMapperConfig
    truth: tuple[IntArray, FloatArray]
    truth_map: OccupancyMap | None


@dataclass(frozen=True, slots=True, eq=False)
class _Mapped:
    """What one estimator made of a recording."""

    trajectory: tuple[IntArray, FloatArray]
    map: OccupancyMap
    error: TrajectoryError
    seconds: float
    diagnostics: dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=10, help="simulated missions (0: none)")
    parser.add_argument("--place", choices=PLACES, default="harbour")
    parser.add_argument("--duration", type=float, default=900.0, help="of each mission [s]")
    parser.add_argument("--ping-rate", type=float, default=2.0, metavar="HZ")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder with aracati2017")
    parser.add_argument(
        "--aracati-config",
        type=Path,
        default=Path("config/aracati2017.yaml"),
        metavar="FILE",
        help="settings for the real recording (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Map everything twice, write table and pictures."""
    rows = []
    with TemporaryDirectory() as work:
        for case in _cases(args, Path(work)):
            results = [_map(case, estimator) for estimator in _ESTIMATORS]
            _draw(args.out / f"{case.name}.png", case, results)
            row = _row(case, results)
            rows.append(row)
            print(f"{case.name}: {row['dead_reckoning_m']} m -> {row['slam_m']} m")
    if not rows:
        raise DataError("nothing to map: give --seeds or --data")
    write_csv(args.out / "slam.csv", rows)
    print_table(list(rows[0]), [list(row.values()) for row in rows])
    simulated = [row for row in rows if row["case"].startswith(args.place)]
    if simulated:
        ratio = [float(row["slam_m"]) / float(row["dead_reckoning_m"]) for row in simulated]
        total = sum(float(r["slam_m"]) ** 2 for r in simulated)
        total /= sum(float(r["dead_reckoning_m"]) ** 2 for r in simulated)
        print(
            f"SLAM over dead reckoning in {len(ratio)} missions: median {np.median(ratio):.2f}, "
            f"of all errors together {total**0.5:.2f}"
        )
    return 0


def _cases(args: argparse.Namespace, work: Path) -> Iterator[_Case]:
    for seed in progress(range(args.seeds), text="missions"):
        config = MissionConfig(
            seed=seed,
            place=args.place,
            num_vehicles=1,
            duration_s=args.duration,
            ping_rate_hz=args.ping_rate,
        )
        mission = simulate_mission(work / f"seed_{seed}", config)
        yield _Case(
            f"{args.place}_{seed}",
            mission.bags[0],
            VehicleMapperConfig(),
            read_tum(mission.truth_trajectories[0]),
            read_map(mission.truth_map),
        )
    try:
        folder = data_dir(args.data, "aracati2017")
    except DataError as error:
        if args.data is not None:
            raise
        print(f"Aracati 2017 is left out: {error}")
        return
    recording = read_aracati2017(folder)
    file = SettingsFile(args.aracati_config)
    settings = file.section(VehicleMapperConfig, "mapper", "/auv_1/sonar_mapper")
    spans = {"aracati_whole": (0, recording.num_keyframes - 1)}
    spans |= {f"aracati_part_{i + 1}": span for i, span in enumerate(SEGMENTS)}
    for name, span in spans.items():
        bag = write_bag(recording, work / name, "auv_1", span)
        yield _Case(name, bag, settings, read_tum(work / name / "truth" / "auv_1.tum"), None)


def _map(case: _Case, estimator: str) -> _Mapped:
    mapper = VehicleMapper(replace(case.config, estimator=estimator), "auv_1")
    frames = StaticFrames()
    start = time.process_time()
    for event in read_events(case.bag):
        if isinstance(event, TransformEvent):
            frames.add(event.frame_id, event.child_frame_id, event.T_parent_child)
        elif not isinstance(event, TruthEvent):
            feed(mapper, event, frames.lookup("auv_1/base_link", event.frame_id))
    mapper.finish()
    seconds = time.process_time() - start
    trajectory = mapper.trajectory()
    error = trajectory_error({"auv_1": trajectory}, {"auv_1": case.truth})
    return _Mapped(trajectory, mapper.vehicle_map(), error, seconds, mapper.diagnostics())


def _row(case: _Case, results: list[_Mapped]) -> dict[str, Any]:
    blind, slam = results
    stamps = slam.trajectory[0]
    row: dict[str, Any] = {
        "case": case.name,
        "pings": len(stamps),
        "dead_reckoning_m": f"{blind.error.rmse_m:.3f}",
        "slam_m": f"{slam.error.rmse_m:.3f}",
        "slam_max_m": f"{slam.error.max_m:.2f}",
        "submaps": slam.diagnostics["num_submaps"],
        "loops": slam.diagnostics["num_loops_believed"],
        "real_time_factor": f"{(stamps[-1] - stamps[0]) * 1e-9 / slam.seconds:.0f}",
    }
    for prefix, result in zip(("before", "after"), results, strict=True):
        row[f"iou_{prefix}"] = row[f"ssim_{prefix}"] = "-"
        if case.truth_map is not None:
            scores = compare_maps(
                result.map,
                case.truth_map,
                result.error.T_truth_map,
                tolerance_m=_WALL_TOLERANCE_M,
                region=case.truth_map.known,
            )
            row[f"iou_{prefix}"] = f"{scores.wall_iou_tolerant:.3f}"
            row[f"ssim_{prefix}"] = f"{scores.ssim:.3f}"
    return row


def _draw(path: Path, case: _Case, results: list[_Mapped]) -> None:
    """Both maps in the truth's frame, with estimated and true trajectories."""
    made, axes = figure(1, 2, width=11.0, height=5.5)
    for axis, title, result in zip(axes[0], _TITLES, results, strict=True):
        if case.truth_map is not None:
            true = case.truth_map.spec.centers_of(np.argwhere(case.truth_map.values > 50))
            axis.plot(*true.T, ",", color="#bbbbbb", label="true walls")
        T_truth_odom = result.error.T_truth_map
        walls = result.map.spec.centers_of(np.argwhere(result.map.values > 65))
        axis.plot(*T_truth_odom.apply(walls).T, ",", color="black")
        stamps, poses = result.trajectory
        true_poses, _ = interpolate_poses(case.truth, stamps)
        axis.plot(*true_poses[:, :2].T, color=COLOURS[2], lw=1.0, label="truth")
        axis.plot(*T_truth_odom.apply(poses[:, :2]).T, color=COLOURS[1], lw=0.8, label="estimate")
        axis.set_title(f"{title}: RMSE {result.error.rmse_m:.2f} m")
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]")
    axes[0, 0].set_ylabel("y [m]")
    axes[0, 0].legend(loc="best")
    save_figure(made, path)
