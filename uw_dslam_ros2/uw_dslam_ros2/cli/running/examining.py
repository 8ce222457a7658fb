"""What vehicles' recordings are like, found out before any of them is mapped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.doctor.fleet import share_sound_speed
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.bags import TransformEvent
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.examining import examine_recording
from uw_dslam_ros2.io.mountings import Mountings, base_frame_of
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.io.vehicles import VehicleRecording

__all__ = ["ExaminedVehicle", "can_be_mapped", "examine_vehicle", "mountings_of", "together"]


@dataclass(frozen=True, slots=True, eq=False)
class ExaminedVehicle:
    """One vehicle's clocks, conventions and mountings.

    ``stamps`` has the times (N,) [ns] of each role's messages, on one clock.
    """

    stamps: Mapping[str, NDArray[np.int64]]
    about_clocks: tuple[Finding, ...]
    mountings: Mountings
    examination: Examination


def can_be_mapped(recording: VehicleRecording) -> bool:
    """Whether it has a sonar, and something that knows the heading."""
    return "sonar" in recording.topics and bool({"imu", "odometry"} & set(recording.topics))


def examine_vehicle(
    recording: VehicleRecording,
    sensors: SensorConfig,
    sonar: SonarConfig,
    note: Callable[[VehicleReader], None] | None = None,
) -> ExaminedVehicle:
    """Examine one recording; `DataError` where its bags cannot be read.

    `note` is called with each reader when it has been read.
    """
    with VehicleReader(recording, sensors) as reader:
        about_clocks = tuple(reader.check_clocks())
        stamps = reader.stamps
        mountings = mountings_of(recording, sensors, reader.transforms())
    examination = examine_recording(recording, sensors, sonar, stamps, mountings.of, note)
    return ExaminedVehicle(stamps, about_clocks, mountings, examination)


def together(examined: Sequence[ExaminedVehicle]) -> list[ExaminedVehicle]:
    """The same, with what vehicles in one water tell of each other."""
    shared = share_sound_speed([own.examination for own in examined])
    return [replace(own, examination=e) for own, e in zip(examined, shared, strict=True)]


def mountings_of(
    recording: VehicleRecording, sensors: SensorConfig, transforms: Iterable[TransformEvent]
) -> Mountings:
    """Where a vehicle's instruments sit."""
    known = list(transforms)
    links = {(t.frame_id, t.child_frame_id) for t in known}
    mountings = Mountings(
        sensors.base_frame or base_frame_of(links, recording.vehicle_id, recording.namespace)
    )
    for transform in known:
        mountings.add(transform)
    return mountings
