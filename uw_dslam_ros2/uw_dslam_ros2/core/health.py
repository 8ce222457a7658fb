"""What a mapped vehicle's counters say of its recording: pure functions of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.clocks import Gap
from uw_dslam_ros2.core.findings import Finding

__all__ = ["MappedVehicle", "SensorCount", "health_findings", "sensor_findings"]

_MANY = 20
"""Fewer messages or matches than this say nothing in shares."""
_MOST = 0.5
_NEARLY_ALL = 0.9
_FEW_MATCHES = 0.3
_MOVED_M = 1.0
_SELDOM_S = 2.5
_Tell = Callable[[str, str, str], None]
_NAVIGATION = ("velocity", "imu", "odometry")


@dataclass(frozen=True, slots=True)
class SensorCount:
    """What became of one sensor's messages: all, bad ones, and those that said nothing.

    ``num_early`` of ``num_empty`` came before the first one that said something: a DVL has no
    lock on deck.
    """

    num: int
    num_bad: int = 0
    num_empty: int = 0
    problem: str = ""
    num_early: int = 0

    @property
    def num_useful(self) -> int:
        """Those that said something."""
        return self.num - self.num_bad - self.num_empty


@dataclass(frozen=True, slots=True, eq=False)
class MappedVehicle:
    """Counters of one vehicle after mapping.

    Parameters
    ----------
    sensors : by role, of the topics that were read.
    counts : the mapper's diagnostics.
    gaps : silences of its sensors.
    spans : first and last stamp [ns] of each role.
    trajectory_stamp_ns, trajectory : (K,) and (K, 3) of the vehicle at its pings.
    has_yaw, has_yaw_rate : whether any message of the imu had them, that was read.
    is_yaw_left_out : whether its orientation is left out by the conventions.
    """

    vehicle_id: str
    sensors: Mapping[str, SensorCount]
    counts: Mapping[str, float | int | str]
    gaps: Sequence[Gap] = ()
    spans: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    trajectory_stamp_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    trajectory: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    has_yaw: bool = True
    has_yaw_rate: bool = True
    is_yaw_left_out: bool = False

    def count(self, name: str) -> int:
        """One of the mapper's counters; 0 where it has none."""
        value = self.counts.get(name, 0)
        return int(value) if isinstance(value, int | float) and math.isfinite(value) else 0


def sensor_findings(vehicle: MappedVehicle) -> list[Finding]:
    """What can be told before anything is mapped: which sensors are there, and say something."""
    found: list[Finding] = []

    def tell(kind: str, role: str, detail: str) -> None:
        found.append(Finding(kind, role, detail, vehicle_id=vehicle.vehicle_id))

    _check_sensors(vehicle, tell)
    _check_overlap(vehicle, tell)
    _check_rate(vehicle, tell)
    return found


def health_findings(vehicle: MappedVehicle) -> list[Finding]:
    """What should be told of a vehicle; an "error" means that there is no map of it."""
    found = sensor_findings(vehicle)

    def tell(kind: str, role: str, detail: str) -> None:
        found.append(Finding(kind, role, detail, vehicle_id=vehicle.vehicle_id))

    _check_pings(vehicle, tell)
    _check_navigation(vehicle, tell)
    _check_gaps(vehicle, tell)
    if not vehicle.count("num_submaps"):
        why = "; ".join(f.sentence.removeprefix(f"{vehicle.vehicle_id} ") for f in found)
        found.append(
            Finding(
                "nothing_mapped",
                "",
                "nothing was mapped" + (f" ({why})" if why else ""),
                severity="error",
                vehicle_id=vehicle.vehicle_id,
            )
        )
    return found


def _check_sensors(vehicle: MappedVehicle, tell: _Tell) -> None:
    sensors = vehicle.sensors
    if not sensors.get("sonar", SensorCount(0)).num:
        tell("no_sonar", "sonar", "there is no topic with a sonar's messages")
    has_heading = vehicle.has_yaw or vehicle.has_yaw_rate
    odometry = sensors.get("odometry")
    if odometry is not None and odometry.num >= _MANY and not odometry.num_useful:
        tell(
            "empty_odometry",
            "odometry",
            f"none of its {odometry.num} messages has a pose or a velocity",
        )
        odometry = None
    if odometry is None:
        if "imu" not in sensors:
            tell(
                "no_heading",
                "imu",
                "there is no imu and no odometry, and so no heading, without which no honest map "
                "can be made",
            )
        elif not has_heading:
            tell("no_heading", "imu", "its messages have neither orientation nor rates")
        elif not vehicle.has_yaw:
            why = (
                "its orientation is left out (conventions.imu_orientation: none)"
                if vehicle.is_yaw_left_out
                else "its messages have no orientation"
            )
            tell(
                "no_heading",
                "imu",
                f"{why}: the heading is integrated from its rates, and drifts",
            )
        if "velocity" not in sensors:
            tell("no_velocity", "velocity", "there is no dvl and no odometry: speed is guessed")
    for role, count in sensors.items():
        if count.num_bad:
            tell(
                "bad_messages",
                role,
                f"{count.num_bad} of {count.num} messages are malformed and left out; "
                f"the first: {count.problem}",
            )
        num = count.num - count.num_early
        if role == "velocity" and num >= _MANY and count.num_useful < _MOST * num:
            tell(
                "no_bottom_lock",
                role,
                f"only {count.num_useful} of {num} messages hold a velocity over ground",
            )


def _check_overlap(vehicle: MappedVehicle, tell: _Tell) -> None:
    if "sonar" not in vehicle.spans:
        return
    start_ns, end_ns = vehicle.spans["sonar"]
    for role in _NAVIGATION:
        if role in vehicle.spans:
            first_ns, last_ns = vehicle.spans[role]
            if last_ns < start_ns or first_ns > end_ns:
                apart_s = max(start_ns - last_ns, first_ns - end_ns) * 1e-9
                tell(
                    "no_overlap",
                    role,
                    f"its stamps and those of the sonar do not overlap: they are {apart_s:.0f} s "
                    "apart; are the clocks of both computers set?",
                )


def _check_rate(vehicle: MappedVehicle, tell: _Tell) -> None:
    num = vehicle.sensors.get("velocity", SensorCount(0)).num
    if num < 2 or "velocity" not in vehicle.spans:
        return
    first_ns, last_ns = vehicle.spans["velocity"]
    period_s = (last_ns - first_ns) * 1e-9 / (num - 1)
    if period_s > _SELDOM_S:
        tell(
            "seldom",
            "velocity",
            f"it has a message only every {period_s:.0f} s, and between them the speed is guessed",
        )


def _check_pings(vehicle: MappedVehicle, tell: _Tell) -> None:
    mapped, dropped = vehicle.count("num_pings"), vehicle.count("num_pings_dropped")
    if dropped > _MOST * (mapped + dropped):
        tell(
            "pings_dropped",
            "sonar",
            f"{dropped} of {mapped + dropped} pings are not used, because there was no navigation "
            "at their time or their stamps do not rise",
        )
    blind = vehicle.count("num_pings_blind")
    if blind >= _MANY:
        tell(
            "pings_blind",
            "imu",
            f"{blind} of {mapped + dropped + blind} pings are not mapped, because it says nothing "
            "of the heading then",
        )
    empty = vehicle.count("num_pings_empty")
    if mapped and empty == mapped:
        tell(
            "no_echoes",
            "sonar",
            f"no echo was found in any of {mapped} pings: are the images black, or all white, or "
            "is the threshold (mapper.sonar) too high?",
        )
    elif mapped >= _MANY and empty > _NEARLY_ALL * mapped:
        tell("few_echoes", "sonar", f"no echo was found in {empty} of {mapped} pings")
    keys, matches = vehicle.count("num_key_pings"), vehicle.count("num_matches")
    if keys >= _MANY and matches < _FEW_MATCHES * keys and empty < _MOST * mapped:
        tell(
            "few_matches",
            "sonar",
            f"only {matches} of {keys} key pings match what was seen before: the map is as good "
            "as dead reckoning, or the sonar's frame, bearings, order of rows or clock are wrong",
        )


def _check_navigation(vehicle: MappedVehicle, tell: _Tell) -> None:
    for role in _NAVIGATION:
        used = vehicle.count(f"num_{role}_used")
        refused = vehicle.count(f"num_{role}_outliers")
        if used + refused >= _MANY and refused > _MOST * (used + refused):
            tell(
                "outliers",
                role,
                f"{100 * refused / (used + refused):.0f} % of its measurements contradict the "
                "others and are refused: are its axes, signs and units right?",
            )


def _check_gaps(vehicle: MappedVehicle, tell: _Tell) -> None:
    for gap in vehicle.gaps:
        if gap.role not in ("sonar", *_NAVIGATION):
            continue
        moved_m = _way_between(vehicle, gap.start_ns, gap.end_ns)
        if moved_m >= _MOVED_M:
            tell(
                "gap",
                gap.role,
                f"it is silent for {gap.seconds:.0f} s in which the vehicle moves about "
                f"{moved_m:.0f} m",
            )


def _way_between(vehicle: MappedVehicle, start_ns: int, end_ns: int) -> float:
    """Length of the trajectory [m] in a time; poses at both ends are interpolated."""
    stamps, poses = vehicle.trajectory_stamp_ns, vehicle.trajectory
    if len(stamps) < 2:
        return 0.0
    lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    seconds = (stamps - stamps[0]) * 1e-9
    ends = (np.array([start_ns, end_ns]) - int(stamps[0])) * 1e-9
    return float(np.diff(np.interp(ends, seconds, way))[0])
