"""Recordings that are wrong in a known way, and clean ones: whether the doctor names the cause.

Missions are simulated in memory, in the harbour and in the lake. Each is examined as it is, and
once for each corruption of ``--only`` (default: all). "first" is the share in which the first
warning names the cause, "mended" that in which the conventions found undo it and nothing else is
changed, "wrongly" that in which they change what was right. ``--clean`` adds missions without a
corruption, of other seeds: usual ones, short ones, ones with poor instruments and ones with few
pings of a coarse sonar, in turns.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from uw_dslam_ros2.cli.studies._common import print_table, progress, share_interval, write_csv
from uw_dslam_ros2.cli.studies._corruptions import CORRUPTIONS, Corruption
from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.examining import examine_readings
from uw_dslam_ros2.io.readings import ImageEvent, Reading
from uw_dslam_ros2.sim.missions.mission import MissionConfig, plan_mission
from uw_dslam_ros2.sim.missions.readings import MissionReadings, mounting_of
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig as SimulatedSonar
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig
from uw_dslam_ros2.sim.waters.places import PLACES

__all__ = ["add_arguments", "examined", "run"]

_CLEAN_SEEDS = 1000
_SHORT_S = 45.0
_POOR = InstrumentConfig(
    # Three of these are 3 degrees a minute, from where on a heading is told to drift.
    gyro_bias_deg_h=60.0,
    angle_walk_deg_sqrt_h=3.0,
    yaw_noise_rad=math.radians(0.5),
    gyro_noise_rad_s=5e-3,
    dvl_noise_m_s=0.03,
    dvl_misalignment_rad=math.radians(1.0),
    dvl_dropouts_per_min=3.0,
    dvl_dropout_s=3.0,
    dvl_outlier_share=0.02,
)
_COARSE = SimulatedSonar(num_beams=96, num_ranges=200, max_range_m=20.0)
_NONE = "none"
_ANGLE, _FACTOR, _DELAY_S = math.radians(4.0), 0.02, 0.15


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=10, help="missions in each place")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--clean", type=int, default=150, help="further missions, all clean")
    parser.add_argument("--places", nargs="*", choices=PLACES, default=["harbour", "lake"])
    parser.add_argument("--only", nargs="*", choices=sorted(CORRUPTIONS), metavar="CORRUPTION",
                        help=f"some of: {', '.join(CORRUPTIONS)}".replace("%", "%%"))  # fmt: skip
    parser.add_argument("--duration", type=float, default=150.0, help="of each mission [s]")


@dataclass(frozen=True, slots=True)
class Case:
    """What the doctor said of one recording."""

    kinds: tuple[str, ...]
    conventions: Conventions
    confidence: float
    num_motions: int
    seconds: float
    details: tuple[str, ...]

    def is_named(self, corruption: Corruption) -> bool:
        """Whether the first warning names the cause; of nothing wrong, whether there is none."""
        if not corruption.kinds:
            return not self.kinds
        return bool(self.kinds) and self.kinds[0] in corruption.kinds

    def is_mended(self, corruption: Corruption) -> bool:
        """Whether the conventions found undo the corruption."""
        return set(self.conventions.changes()) == set(corruption.mends) and not self.is_wrong(
            corruption
        )

    def is_wrong(self, corruption: Corruption) -> bool:
        """Whether something is changed that was right, or by a wrong amount."""
        return any(
            name not in corruption.mends or not _is_close(name, value, corruption.mends[name])
            for name, value in self.conventions.changes().items()
        )


def _is_close(name: str, found: str | float | bool, true: str | float | bool) -> bool:
    if isinstance(found, str | bool) or isinstance(true, str | bool):
        return found == true
    if name.endswith("_rad"):
        return abs(math.remainder(found - true, 2.0 * math.pi)) < _ANGLE
    if name.endswith("_s"):
        return abs(found - true) < _DELAY_S
    return abs(found / true - 1.0) < _FACTOR


def examined(source: MissionReadings, corruption: Corruption) -> Case:
    """Examine a vehicle's readings with something wrong about them."""
    told: list[Finding] = []
    change = corruption.start(told.append)
    start_ns = min(int(stamps[0]) for stamps in source.stamps.values())
    late_ns = {role: round(corruption.delay_s.get(role, 0.0) * 1e9) for role in source.stamps}
    stamps = {role: stamps + late_ns[role] for role, stamps in source.stamps.items()}

    def readings(is_wanted: Any) -> Iterator[Reading]:
        def is_wanted_late(role: str, stamp_ns: int) -> bool:
            return bool(is_wanted(role, stamp_ns + late_ns[role]))

        for reading in source(is_wanted_late):
            elapsed_s = (reading.stamp_ns - start_ns) * 1e-9
            yield change(_stamped(reading, late_ns), elapsed_s)

    begin = time.process_time()
    found = examine_readings(
        readings, Conventions(), SonarConfig(), stamps, mounting_of, source.vehicle_id
    )
    warnings = [f for f in (*told, *found.findings) if f.severity != "info"]
    return Case(
        tuple(f.kind for f in warnings),
        found.conventions,
        warnings[0].confidence if warnings else math.nan,
        found.num_ping_motions,
        time.process_time() - begin,
        tuple(f.detail for f in warnings),
    )


def _stamped(reading: Reading, late_ns: Mapping[str, int]) -> Reading:
    role = {"sonar": "sonar", "dvl": "velocity", "imu": "imu"}[reading.frame_id]
    if not late_ns[role]:
        return reading
    stamp_ns = reading.stamp_ns + late_ns[role]
    if isinstance(reading, ImageEvent):
        return replace(reading, stamp_ns=stamp_ns, image=replace(reading.image, stamp_ns=stamp_ns))
    return replace(reading, stamp_ns=stamp_ns)


def run(args: argparse.Namespace) -> int:
    """Examine; write ``doctor.csv`` and print what was named how often."""
    names = [_NONE, *(name for name in CORRUPTIONS if name != _NONE)]
    if args.only:
        names = [name for name in names if name in args.only]
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    usual = MissionConfig(num_vehicles=1, duration_s=args.duration)
    jobs = [(replace(usual, place=p, seed=s), "usual", names) for p in args.places for s in seeds]
    jobs += [(*_clean_mission(usual, args, number), [_NONE]) for number in range(args.clean)]
    rows: list[dict[str, Any]] = []
    cases: dict[str, list[Case]] = {}
    for config, kind, wanted in progress(jobs, text="missions"):
        source = MissionReadings(plan_mission(config))
        for name in wanted:
            case = examined(source, CORRUPTIONS[name])
            cases.setdefault(name, []).append(case)
            rows.append(_row(config, kind, name, case))
            if not case.is_named(CORRUPTIONS[name]) or case.is_wrong(CORRUPTIONS[name]):
                said = "; ".join(case.details) or "nothing"
                print(f"{config.place} {config.seed}, {kind}, {name}: {said}", flush=True)
    write_csv(args.out / "doctor.csv", rows)
    _print_summary(cases)
    return 0


def _clean_mission(
    usual: MissionConfig, args: argparse.Namespace, number: int
) -> tuple[MissionConfig, str]:
    seed = _CLEAN_SEEDS + args.first_seed + number
    base = replace(usual, place=args.places[number % len(args.places)], seed=seed)
    kinds = {
        "usual": base,
        "short": replace(base, duration_s=_SHORT_S),
        "poor instruments": replace(base, instruments=_POOR),
        "few pings": replace(base, ping_rate_hz=1.0, sonar=_COARSE),
    }
    kind = list(kinds)[number // len(args.places) % len(kinds)]
    return kinds[kind], kind


def _row(config: MissionConfig, kind: str, name: str, case: Case) -> dict[str, Any]:
    corruption = CORRUPTIONS[name]
    return {
        "place": config.place,
        "seed": config.seed,
        "mission": kind,
        "corruption": name,
        "kinds": " ".join(case.kinds),
        "named": int(case.is_named(corruption)),
        "mended": int(case.is_mended(corruption)),
        "wrongly": int(case.is_wrong(corruption)),
        "confidence": f"{case.confidence:.3f}",
        "motions": case.num_motions,
        "cpu_s": f"{case.seconds:.2f}",
    }


def _print_summary(cases: Mapping[str, list[Case]]) -> None:
    table = []
    for name, found in cases.items():
        corruption, total = CORRUPTIONS[name], len(found)
        counts = [
            sum(case.is_named(corruption) for case in found),
            sum(case.is_mended(corruption) for case in found),
            sum(case.is_wrong(corruption) for case in found),
        ]
        low, high = share_interval(counts[0], total)
        table.append([name, total, *counts, f"{low:.2f} to {high:.2f}"])
    print_table(["wrong", "recordings", "first", "mended", "wrongly", "95 % of first"], table)
    wrong = [(n, c) for n, found in cases.items() if CORRUPTIONS[n].kinds for c in found]
    right = [c for n, found in cases.items() if not CORRUPTIONS[n].kinds for c in found]
    named = sum(case.is_named(CORRUPTIONS[name]) for name, case in wrong)
    alarms = sum(bool(case.kinds) for case in right)
    print(f"right cause first: {named} of {len(wrong)}; false alarms: {alarms} of {len(right)}")
