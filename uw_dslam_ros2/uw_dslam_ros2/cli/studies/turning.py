"""A basin mapped by sonars that turn, whose zero and heading are off, with what the doctor finds.

Each seed is a mission of slow vehicles without a common start, recorded in every form of
``--messages``. The recording is examined (`doctor`) and mapped with the settings that it writes
(`offline`). The table has what was found beside what is true, and the error of the trajectories in
one frame. ``--blind`` adds dead reckoning with the same settings.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from uw_dslam_ros2.cli import doctor, offline
from uw_dslam_ros2.cli.studies._common import print_table, progress, write_csv
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.sim.missions.mission import MissionConfig
from uw_dslam_ros2.sim.missions.recording import RecordedMission, simulate_mission
from uw_dslam_ros2.sim.sonars.turning import TURNING_MESSAGES, TurningSonarConfig
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig

__all__ = ["add_arguments", "mission_config", "run"]

_SURVEY = InstrumentConfig(
    imu_rate_hz=10.0,
    dvl_rate_hz=2.0,
    dvl_noise_m_s=0.02,
    dvl_scale_sigma=0.02,
    dvl_bias_m_s=0.004,
    dvl_misalignment_rad=0.015,
    dvl_dropout_s=3.0,
    gyro_bias_deg_h=3.0,
    gyro_bias_walk_deg_h=2.0,
    angle_walk_deg_sqrt_h=1.0,
    yaw_noise_rad=0.01,
)
"""Instruments of an inspection vehicle of years ago: metres off after some hundred metres."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=2, help="missions")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--vehicles", type=int, default=1, metavar="N")
    parser.add_argument("--duration", type=float, default=600.0, metavar="S")
    parser.add_argument("--width", type=float, default=80.0, metavar="M", help="of the basin")
    parser.add_argument("--overlap", type=float, default=0.35, help="of the vehicles' areas")
    parser.add_argument("--zero", type=float, default=94.0, metavar="DEG")
    parser.add_argument("--imu-delay", type=float, default=0.8, metavar="S")
    parser.add_argument(
        "--messages", nargs="+", choices=TURNING_MESSAGES, default=list(TURNING_MESSAGES)
    )
    parser.add_argument("--blind", action="store_true", help="dead reckoning too")


def mission_config(args: argparse.Namespace, seed: int, message: str) -> MissionConfig:
    """A slow survey whose sonar counts clockwise from a zero of its own."""
    return MissionConfig(
        seed=seed,
        num_vehicles=args.vehicles,
        place_width_m=args.width,
        duration_s=args.duration,
        overlap=args.overlap,
        truth_resolution_m=0.25,
        sonar_kind="turning",
        turning=TurningSonarConfig(
            max_range_m=50.0,
            num_ranges=500,
            message=message,
            zero_rad=math.radians(args.zero),
            is_clockwise=True,
        ),
        drive=DriveConfig(speed_m_s=0.4, max_yaw_rate_rad_s=0.12, depth_m=2.0, current_m_s=0.03),
        instruments=replace(_SURVEY, imu_delay_s=args.imu_delay),
    )


def run(args: argparse.Namespace) -> int:
    """Simulate, examine, map; write the table."""
    rows: list[dict[str, Any]] = []
    cases = [
        (args.first_seed + i, message) for i in range(args.seeds) for message in args.messages
    ]
    for seed, message in progress(cases, text="recordings"):
        with TemporaryDirectory() as work:
            mission = simulate_mission(Path(work) / "mission", mission_config(args, seed, message))
            rows.append({"seed": seed, "message": message, **_mapped(mission, Path(work), args)})
        write_csv(args.out / "turning.csv", rows)
    if rows:
        print_table(list(rows[0]), [list(row.values()) for row in rows])
    return 0


def _mapped(mission: RecordedMission, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    bags = [str(bag) for bag in mission.bags]
    _call(doctor.main, [*bags, "--out", str(work / "doctor")])
    report = json.loads((work / "doctor" / "doctor.json").read_text())
    found = [vehicle["conventions"] for vehicle in report["vehicles"]]
    zeros = [math.degrees(c["sonar_yaw_offset_rad"]) for c in found]
    row: dict[str, Any] = {
        "zero_deg": "/".join(f"{zero:.1f}" for zero in zeros),
        "clockwise": "/".join(str(c["sonar_is_mirrored"]) for c in found),
        "delay_s": "/".join(f"{c['imu_delay_s']:.2f}" for c in found),
    }
    settings = (work / "doctor" / "settings.yaml").read_text()
    row |= _scored(mission, work / "map", settings)
    if args.blind:
        everyone = "/**:\n  ros__parameters:\n    mapper.estimator: dead_reckoning\n"
        row["blind_m"] = _scored(mission, work / "blind", settings + everyone)["error_m"]
    return row


def _scored(mission: RecordedMission, out: Path, settings: str) -> dict[str, Any]:
    config = out.with_suffix(".yaml")
    config.write_text(settings)
    bags = [str(bag) for bag in mission.bags]
    truth = str(mission.truth_map.parent)
    options = ["--truth", truth, "--config", str(config), "--out", str(out), "--no-report"]
    _call(offline.main, [*bags, *options])
    report = json.loads((out / "report.json").read_text())
    return _figures(report)


def _figures(report: dict[str, Any]) -> dict[str, Any]:
    scores = report["scores"]
    alone = scores["rmse_m_of_each_vehicle_alone"]
    return {
        "merged": f"{report['num_vehicles_merged']} of {report['num_vehicles']}",
        "error_m": f"{scores['trajectory']['rmse_m']:.2f}",
        "alone_m": "/".join(f"{alone[vehicle]:.2f}" for vehicle in sorted(alone)),
        "notes": len(report["notes"]),
    }


def _call(main: Any, arguments: Sequence[str]) -> None:
    if code := main(arguments):
        raise DataError(f"{main.__module__} ended with {code}")
