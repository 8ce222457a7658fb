"""Blue Robotics Ping360: ``SonarEcho``, one beam of a sonar that turns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers.adapter import Adapter, as_bytes, key_of, stamp_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import BeamsEvent

__all__ = ["ADAPTERS", "read_echo"]

_RAD_PER = {"radian": 1.0, "degree": math.pi / 180.0, "gradian": math.pi / 200.0}


def read_echo(msg: Any, settings: ReadSettings) -> Sequence[BeamsEvent]:
    """Read one beam with its intensities.

    The angle counts from the frame's x axis to y, as in the driver's own image and scan.
    """
    intensity = as_bytes(msg.intensities, "intensities")
    if len(intensity) == 0:
        return ()
    angle, range_max_m = float(msg.angle), float(msg.range)
    bearing_rad = angle * _RAD_PER[settings.sonar_angle_unit]
    if not (math.isfinite(angle) and abs(bearing_rad) < 2.0 * math.pi + 0.1):
        raise InvalidInputError(
            f"angle is {angle} {settings.sonar_angle_unit}, expected at most a turn; "
            "set sonar_angle_unit to gradian or degree if the driver has those"
        )
    if range_max_m <= 0.0:
        raise InvalidInputError(f"range is {range_max_m}, expected a positive number of metres")
    num_bins = len(intensity)
    return (
        BeamsEvent(
            *key_of(msg, settings),
            beam_stamp_ns=np.array([stamp_of(msg)], np.int64),
            bearing_rad=np.array([math.remainder(bearing_rad, 2.0 * math.pi)]),
            range_m=(np.arange(num_bins, dtype=np.float64) + 0.5) * (range_max_m / num_bins),
            range_max_m=range_max_m,
            intensity=intensity.reshape(-1, 1),
        ),
    )


ADAPTERS = tuple(
    Adapter(f"{package}/msg/SonarEcho", ("sonar",), read_echo)
    for package in ("ping360_sonar_msgs", "ping360_sonar")
)
