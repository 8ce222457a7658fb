"""A vehicle's recording examined: a sample of its pings, and all of its navigation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination, SampleCollector, examine
from uw_dslam_ros2.core.doctor.judging.climb import Climb
from uw_dslam_ros2.core.doctor.judging.lean import Lean
from uw_dslam_ros2.core.doctor.motions.ping_motion import have_echoes
from uw_dslam_ros2.core.doctor.samples.bursts import choose_pings, more_pings
from uw_dslam_ros2.core.doctor.turning.verdict import (
    choose_spans,
    examine_turning,
    examine_turning_by_odometry,
)
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.conventions import CorrectedMountings, correct
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.feeding import feed
from uw_dslam_ros2.io.readings import (
    Event,
    ImuEvent,
    PoseEvent,
    Reading,
    TransformEvent,
    TruthEvent,
    VelocityEvent,
)
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.io.vehicles import VehicleRecording

__all__ = ["examine_readings", "examine_recording", "mended"]

_SLOW_NS = 3_000_000_000
_TURN_NS = 40_000_000_000

MountingOf = Callable[[Reading], NDArray[np.float64]]
IsWanted = Callable[[str, int | None], bool]
Source = Callable[[IsWanted], Iterable[Event]]
"""Readings whose role and stamp are wanted; it may be asked more than once."""


def examine_recording(
    recording: VehicleRecording,
    sensors: SensorConfig,
    sonar: SonarConfig,
    stamps: Mapping[str, NDArray[np.int64]],
    mounting_of: MountingOf,
    note: Callable[[VehicleReader], None] | None = None,
) -> Examination:
    """Try the conventions of a vehicle's sensors.

    Parameters
    ----------
    stamps : role -> times (N,) [ns] of all its messages, as `VehicleReader.check_clocks` has them.
    mounting_of : ``T_base_sensor`` (4, 4) of a reading.
    note : called with the reader after each pass, for what it says of the messages.
    """

    def source(is_wanted: IsWanted) -> Iterable[Event]:
        with VehicleReader(recording, sensors) as reader:
            reader.stamps = dict(stamps)
            yield from reader.events(is_wanted)
            if note is not None:
                note(reader)

    return examine_readings(
        source, sensors.conventions, sonar, stamps, mounting_of, recording.vehicle_id
    )


def examine_readings(
    source: Source,
    conventions: Conventions,
    sonar: SonarConfig,
    stamps: Mapping[str, NDArray[np.int64]],
    mounting_of: MountingOf,
    vehicle_id: str = "",
) -> Examination:
    """Try the conventions of a vehicle's sensors; parameters as in `examine_recording`."""
    collector, leaning, climbing = SampleCollector(sonar), Lean(), Climb()
    changes: dict[str, Any] = {}
    is_axis_open = False

    def collect(is_wanted: IsWanted) -> None:
        nonlocal is_axis_open
        corrected = CorrectedMountings(conventions)
        for event in source(is_wanted):
            if isinstance(event, TruthEvent | TransformEvent):
                continue
            try:
                if changes and isinstance(event, ImuEvent):
                    ordered = correct(event, Conventions(**changes))
                    if ordered is None:
                        continue
                    event = ordered
                mounting = corrected.of(event, mounting_of(event))
                if mounting is None:
                    continue
                is_axis_open |= _is_axis_open(event, mounting)
                if (
                    not changes
                    and isinstance(event, ImuEvent)
                    and event.orientation_xyzw is not None
                ):
                    leaning.add(event.orientation_xyzw, mounting[:3, :3])
                if not changes and isinstance(event, VelocityEvent):
                    climbing.add(event.frame_id, mounting[:3, :3] @ event.velocity_m_s)
                feed(collector, event, mounting)  # type: ignore[arg-type]  # has a mapper's inputs
                if isinstance(event, PoseEvent):
                    collector.note_frame(event.frame_id, event.height_m)
            except InvalidInputError:
                continue  # mapping says what is wrong with it

    collect(lambda role, _: role in ("imu", "velocity", "odometry"))
    if changes := leaning.changes():
        conventions = Conventions(**(conventions.to_dict() | changes))
        collector = SampleCollector(sonar)
        collect(lambda role, _: role in ("imu", "velocity", "odometry"))
    navigation, odometry = collector.navigation(), collector.odometry()
    turn_s, rates = navigation.imu_s, navigation.yaw_rate_rad_s
    if not len(turn_s):
        turn_s, rates = odometry.stamp_s, odometry.yaw_rates()
    if "sonar" in stamps and len(turn_s):
        ping_ns = np.unique(stamps["sonar"])
        ping_s = np.asarray((ping_ns - collector.start_ns) * 1e-9, np.float64)
        chosen = choose_pings(ping_s, turn_s, rates)
        wanted = {int(stamp_ns) for stamp_ns in ping_ns[chosen]}
        collect(lambda role, stamp_ns: role == "sonar" and stamp_ns in wanted)
        seen = collector.pings()
        further = more_pings(ping_s, seen.stamp_s, have_echoes(seen))
        if not collector.is_turning and len(further):
            more = {int(stamp_ns) for stamp_ns in ping_ns[further]} - wanted
            collect(lambda role, stamp_ns: role == "sonar" and stamp_ns in more)
    found = examine(collector.navigation(), collector.pings(), vehicle_id, odometry)
    leaning.tell(found)
    leaning.tell_slight(found)
    climbing.tell(found)
    if "sonar" in stamps and (collector.is_turning or _are_slow(stamps["sonar"])):
        found.is_turning = True
        is_alone = not len(navigation.imu_s) and len(odometry.stamp_s) > 1
        known = odometry.as_navigation() if is_alone else navigation
        spans = choose_spans(known, collector.seconds(np.unique(stamps["sonar"])))
        inside = _inside(spans, collector.start_ns)
        collect(lambda role, stamp_ns: role == "sonar" and inside(stamp_ns))
        if is_alone:
            examine_turning_by_odometry(found, odometry, collector.beams(), spans)
        else:
            examine_turning(found, navigation, collector.beams(), spans)
    if is_axis_open:
        found.findings = [
            replace(f, severity="info") if f.kind == "dvl_mirrored" else f for f in found.findings
        ]
    return found


def _are_slow(stamps_ns: NDArray[np.int64]) -> bool:
    """Whether pings come as seldom as the turns of a sonar."""
    return len(stamps_ns) > 1 and float(np.median(np.diff(np.unique(stamps_ns)))) > _SLOW_NS


def _inside(spans: Iterable[tuple[float, float]], start_ns: int) -> Callable[[int | None], bool]:
    """Whether a stamp lies in one of the spans [s]; a turn is stamped with its begin."""
    bounds = [
        (start_ns + int(1e9 * begin_s) - _TURN_NS, start_ns + int(1e9 * end_s))
        for begin_s, end_s in spans
    ]

    def is_inside(stamp_ns: int | None) -> bool:
        return stamp_ns is not None and any(a <= stamp_ns < b for a, b in bounds)

    return is_inside


def _is_axis_open(event: Reading, T_base_sensor: NDArray[np.float64]) -> bool:
    """Whether a velocity is defined with y to port, in a frame whose y is to starboard.

    Both are in use in such frames; that the echoes tell which is no reason to worry.
    """
    return isinstance(event, VelocityEvent) and not event.is_z_down and T_base_sensor[2, 2] < 0.0


def mended(
    examined: Examination, known: Conventions, sonar: SonarConfig
) -> tuple[Conventions, SonarConfig, list[Finding]]:
    """Conventions and a sonar's front end to read a recording by, and what to tell of it.

    What was found is used at once, where the settings say nothing of conventions.
    """
    if known != Conventions():
        return known, sonar, list(examined.findings)
    findings = [
        replace(finding, detail=f"{finding.detail}; it is mapped so")
        if finding.kind in examined.mended
        else finding
        for finding in examined.findings
    ]
    return (
        examined.conventions,
        SonarConfig(**(sonar.to_dict() | examined.sonar_changes)),
        findings,
    )
