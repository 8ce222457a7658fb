"""One vehicle's map before and after SLAM: simulated missions and Aracati 2017, with the truth.

Each recording is mapped by every estimator: dead reckoning alone, scan matching with loop closures
in a graph of submaps, scan matching with a particle filter.
Without ``--data`` (or UW_DATA_DIR) the real recording is left out, and the table says so.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.metrics import (
    TrajectoryError,
    compare_maps,
    interpolate_poses,
    trajectory_error,
)
from uw_dslam_ros2.io.bags import TransformEvent, TruthEvent, read_events
from uw_dslam_ros2.io.datasets.aracati2017 import SEGMENTS, read_aracati2017, write_bag
from uw_dslam_ros2.io.feeding import feed, in_stamp_order
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.sim.missions.mission import SONAR_KINDS, MissionConfig
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.waters.places import PLACES

__all__ = ["add_arguments", "run"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_TITLES = {
    "dead_reckoning": "dead reckoning",
    "scan_matching": "matching and loops",
    "particle_filter": "particle filter",
}
_BLIND, _DEFAULT = "dead_reckoning", VehicleMapperConfig().estimator
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
    parser.add_argument("--seeds", type=int, default=10, help="missions in the harbour (0: none)")
    parser.add_argument("--lake-seeds", type=int, default=3, help="missions in the lake")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=450.0, help="of each mission [s]")
    parser.add_argument("--ping-rate", type=float, default=2.0, metavar="HZ")
    parser.add_argument("--sonar", choices=SONAR_KINDS, default="imaging", help="of the missions")
    parser.add_argument(
        "--estimators",
        nargs="+",
        choices=list(_TITLES),
        default=list(_TITLES),
        help="dead reckoning is always among them",
    )
    add_aracati_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Map everything with every estimator, write table and pictures."""
    estimators = list(dict.fromkeys([_BLIND, *args.estimators]))
    rows = []
    with TemporaryDirectory() as work:
        for case in _cases(args, Path(work)):
            results = {name: _map(case, name) for name in estimators}
            _draw(args.out / f"{case.name}.png", case, results)
            rows.append(_row(case, results))
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
            write_csv(args.out / "slam.csv", rows)
    if not rows:
        raise DataError("nothing to map: give --seeds or --data")
    print_table(list(rows[0]), [list(row.values()) for row in rows])
    for place in PLACES:
        _summarise(place, [r for r in rows if r["case"].startswith(place)], estimators)
    return 0


def _summarise(place: str, rows: list[dict[str, Any]], estimators: list[str]) -> None:
    """How large the errors are against those of dead reckoning."""
    if not rows:
        return
    blind = np.array([float(row[_BLIND]) for row in rows])
    for name in estimators[1:]:
        error = np.array([float(row[name]) for row in rows])
        pooled = float(np.sqrt((error**2).sum() / (blind**2).sum()))
        worst = float((error - blind).max())
        print(
            f"{place}, {name} over dead reckoning in {len(rows)} missions: all errors together "
            f"{pooled:.2f}, median {np.median(error / blind):.2f}; worst change {worst:+.3f} m"
        )


def _cases(args: argparse.Namespace, work: Path) -> Iterator[_Case]:
    missions = [("harbour", args.first_seed + i) for i in range(args.seeds)]
    missions += [("lake", args.first_seed + i) for i in range(args.lake_seeds)]
    for place, seed in progress(missions, text="missions"):
        config = MissionConfig(
            seed=seed,
            place=place,
            num_vehicles=1,
            duration_s=args.duration,
            ping_rate_hz=args.ping_rate,
            sonar_kind=args.sonar,
        )
        mission = simulate_mission(work / f"{place}_{seed}", config)
        yield _Case(
            f"{place}_{seed}",
            mission.bags[0],
            VehicleMapperConfig(),
            read_tum(mission.truth_trajectories[0]),
            read_map(mission.truth_map),
        )
        shutil.rmtree(mission.folder)
    folder = optional_data_dir(args.data, ARACATI)
    if folder is None:
        return
    recording = read_aracati2017(folder)
    file = SettingsFile(aracati_settings(args))
    settings = file.section(VehicleMapperConfig, "mapper", "/auv_1/sonar_mapper")
    spans = {"aracati_whole": (0, recording.num_keyframes - 1)}
    spans |= {f"aracati_part_{i + 1}": span for i, span in enumerate(SEGMENTS)}
    for name, span in spans.items():
        bag = write_bag(recording, work / name, "auv_1", span)
        yield _Case(name, bag, settings, read_tum(work / name / "truth" / "auv_1.tum"), None)


def _map(case: _Case, estimator: str) -> _Mapped:
    mapper = VehicleMapper(replace(case.config, estimator=estimator), "auv_1")
    mountings = Mountings("auv_1/base_link")
    start = time.process_time()
    for event in in_stamp_order(read_events(case.bag)):
        if isinstance(event, TransformEvent):
            mountings.add(event)
        elif not isinstance(event, TruthEvent):
            feed(mapper, event, mountings.of(event))
    mapper.finish()
    seconds = time.process_time() - start
    trajectory = mapper.trajectory()
    error = trajectory_error({"auv_1": trajectory}, {"auv_1": case.truth})
    return _Mapped(trajectory, mapper.vehicle_map(), error, seconds, mapper.diagnostics())


def _row(case: _Case, results: dict[str, _Mapped]) -> dict[str, Any]:
    after = results.get(_DEFAULT, results[_BLIND])
    stamps = after.trajectory[0]
    length_s = (stamps[-1] - stamps[0]) * 1e-9
    row: dict[str, Any] = {"case": case.name, "pings": len(stamps)}
    row |= {name: f"{result.error.rmse_m:.3f}" for name, result in results.items()}
    row["max_m"] = f"{after.error.max_m:.2f}"
    row["submaps"] = after.diagnostics["num_submaps"]
    row["loops"] = after.diagnostics["num_loops_believed"]
    row["real_time_factor"] = "/".join(f"{length_s / r.seconds:.0f}" for r in results.values())
    for prefix, result in (("before", results[_BLIND]), ("after", after)):
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


def _draw(path: Path, case: _Case, results: dict[str, _Mapped]) -> None:
    """All maps in the truth's frame, with estimated and true trajectories."""
    made, axes = figure(1, len(results), width=5.0 * len(results), height=5.0)
    for axis, (name, result) in zip(axes[0], results.items(), strict=True):
        if case.truth_map is not None:
            true = case.truth_map.spec.centers_of(np.argwhere(case.truth_map.values > 50))
            axis.plot(*true.T, ",", color=COLOURS[4], label="true walls")
        T_truth_odom = result.error.T_truth_map
        walls = result.map.spec.centers_of(np.argwhere(result.map.values > 65))
        axis.plot(*T_truth_odom.apply(walls).T, ",", color="black")
        stamps, poses = result.trajectory
        true_poses, _ = interpolate_poses(case.truth, stamps)
        axis.plot(*true_poses[:, :2].T, color=COLOURS[2], lw=1.0, label="truth")
        axis.plot(*T_truth_odom.apply(poses[:, :2]).T, color=COLOURS[1], lw=0.8, label="estimate")
        axis.set_title(f"{_TITLES[name]}: RMSE {result.error.rmse_m:.2f} m")
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]")
    axes[0, 0].set_ylabel("y [m]")
    axes[0, 0].legend(loc="best")
    save_figure(made, path)
