"""Simulate a mission: a place, vehicles that survey it, and a bag of recordings for each."""

from __future__ import annotations

import argparse
import math
import os
import sys
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from uw_dslam_ros2.core.errors import UwDslamError
from uw_dslam_ros2.sim.missions.mission import ALL_SONAR_KINDS, MissionConfig
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.turning import TURNING_MESSAGES
from uw_dslam_ros2.sim.vehicles.instruments import HEADING_SOURCES
from uw_dslam_ros2.sim.vehicles.sway import SwayConfig
from uw_dslam_ros2.sim.waters.places import PLACES

__all__ = ["main"]


def _parser() -> argparse.ArgumentParser:
    default = MissionConfig()
    parser = argparse.ArgumentParser(prog="simulate", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write the mission to")
    parser.add_argument("--seed", type=int, default=default.seed, help="another place for each")
    parser.add_argument("--place", choices=PLACES, default=default.place)
    parser.add_argument("--vehicles", type=int, default=default.num_vehicles, metavar="N")
    parser.add_argument(
        "--duration", type=float, default=default.duration_s, metavar="S", help="of each bag [s]"
    )
    parser.add_argument(
        "--overlap",
        type=float,
        default=default.overlap,
        help="part of an area's width that the next vehicle surveys too",
    )
    parser.add_argument(
        "--sonar",
        choices=ALL_SONAR_KINDS,
        default=default.sonar_kind,
        help="a fan of beams at once, one beam that turns in 14 s, or points in space (3-D)",
    )
    parser.add_argument(
        "--message",
        choices=TURNING_MESSAGES,
        default=default.turning.message,
        help="what a message of a turning sonar holds; points are deskewed",
    )
    parser.add_argument(
        "--zero",
        type=float,
        default=0.0,
        metavar="DEG",
        help="turning sonar: where its zero really points, counter-clockwise from ahead",
    )
    parser.add_argument(
        "--clockwise", action="store_true", help="turning sonar: its angles grow clockwise"
    )
    parser.add_argument(
        "--imu-delay",
        type=float,
        default=default.instruments.imu_delay_s,
        metavar="S",
        help="how much later than true the stamps of the imu are",
    )
    parser.add_argument(
        "--width", type=float, default=0.0, metavar="M", help="of the place; 0: by the vehicles"
    )
    parser.add_argument("--ping-rate", type=float, default=default.ping_rate_hz, metavar="HZ")
    parser.add_argument("--beams", type=int, default=default.sonar.num_beams)
    parser.add_argument("--ranges", type=int, default=default.sonar.num_ranges, help="range bins")
    parser.add_argument(
        "--max-range", type=float, metavar="M", help="default: 40, of a turning sonar 30"
    )
    parser.add_argument("--speed", type=float, default=default.drive.speed_m_s, metavar="M/S")
    parser.add_argument("--heading", choices=HEADING_SOURCES, default="gyro")
    parser.add_argument(
        "--roll", type=float, default=0.0, metavar="DEG", help="amplitude of the vehicles' roll"
    )
    parser.add_argument("--pitch", type=float, default=0.0, metavar="DEG", help="of their pitch")
    parser.add_argument(
        "--tilt", type=float, default=0.0, metavar="DEG", help="how far the sonars look down"
    )
    parser.add_argument(
        "--depth-step",
        type=float,
        default=default.depth_step_m,
        metavar="M",
        help="each vehicle cruises so much deeper than the one before",
    )
    parser.add_argument(
        "--crosstalk",
        type=float,
        default=default.crosstalk_share,
        metavar="SHARE",
        help="part of the pings in which one of another vehicle is heard",
    )
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count() or 1, help="the result is the same"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def _config(arguments: argparse.Namespace) -> MissionConfig:
    default = MissionConfig()
    return MissionConfig(
        seed=arguments.seed,
        place=arguments.place,
        num_vehicles=arguments.vehicles,
        place_width_m=arguments.width,
        duration_s=arguments.duration,
        overlap=arguments.overlap,
        ping_rate_hz=arguments.ping_rate,
        sonar=replace(
            default.sonar,
            num_beams=arguments.beams,
            num_ranges=arguments.ranges,
            max_range_m=arguments.max_range or default.sonar.max_range_m,
        ),
        sonar_kind=arguments.sonar,
        turning=replace(
            default.turning,
            message=arguments.message,
            zero_rad=math.radians(arguments.zero),
            is_clockwise=arguments.clockwise,
            max_range_m=arguments.max_range or default.turning.max_range_m,
        ),
        drive=replace(default.drive, speed_m_s=arguments.speed),
        sway=SwayConfig(
            roll_rad=math.radians(arguments.roll),
            pitch_rad=math.radians(arguments.pitch),
            sonar_tilt_rad=math.radians(arguments.tilt),
        ),
        depth_step_m=arguments.depth_step,
        crosstalk_share=arguments.crosstalk,
        instruments=replace(
            default.instruments, heading_source=arguments.heading, imu_delay_s=arguments.imu_delay
        ),
    )


class _Progress:
    """A bar on a terminal; elsewhere a line for each tenth of the pings."""

    def __init__(self, is_quiet: bool) -> None:
        self._is_plain = not is_quiet and not sys.stderr.isatty()
        self._bar = tqdm(unit="ping", desc="simulate", disable=is_quiet or self._is_plain)
        self._tenths = 0

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, done: int, total: int) -> None:
        if self._is_plain:
            tenths = 10 * done // total
            if tenths > self._tenths:
                self._tenths = tenths
                print(f"simulate: {done} of {total} pings", file=sys.stderr, flush=True)
        else:
            self._bar.total = total
            self._bar.update(done - self._bar.n)


def main(argv: list[str] | None = None) -> int:
    """Run the command; the exit code is 2 for bad input."""
    arguments = _parser().parse_args(argv)
    try:
        config = _config(arguments)
        with _Progress(is_quiet=arguments.quiet) as progress:
            mission = simulate_mission(
                arguments.out,
                config,
                storage=arguments.storage,
                num_processes=arguments.processes,
                progress=progress,
            )
    except KeyboardInterrupt:
        print("simulate: interrupted; nothing is left behind", file=sys.stderr)
        return 130
    except UwDslamError as error:
        print(f"simulate: error: {error}", file=sys.stderr)
        return 2
    size_mb = sum(f.stat().st_size for bag in mission.bags for f in bag.iterdir()) / 1e6
    print(f"{len(mission.bags)} bags, {size_mb:.0f} MB: {', '.join(map(str, mission.bags))}")
    print(f"truth: {mission.truth_map.parent}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
