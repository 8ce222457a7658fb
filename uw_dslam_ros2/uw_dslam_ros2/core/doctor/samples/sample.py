"""What a recording holds of one vehicle, as arrays; times in seconds from a start of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.samples.speckle import Quantity
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["NavigationSample", "PingSample"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class NavigationSample:
    """Navigation in base_link's axes, after its mounting.

    ``imu_s`` (K,) rising, ``yaw_rad`` (K,) and ``yaw_rate_rad_s`` (K,), NaN where not said;
    ``velocity_s`` (V,) rising, ``velocity_m_s`` (V, 2) forward and left, measured at
    ``velocity_lever_m`` (2,).
    """

    imu_s: FloatArray
    yaw_rad: FloatArray
    yaw_rate_rad_s: FloatArray
    velocity_s: FloatArray
    velocity_m_s: FloatArray
    velocity_lever_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, times in (("imu_s", self.imu_s), ("velocity_s", self.velocity_s)):
            if (np.diff(times) < 0.0).any() or not np.isfinite(times).all():
                raise InvalidInputError(f"{name} is not finite and rising")


@dataclass(frozen=True, slots=True, eq=False)
class PingSample:
    """Echoes of some pings: ``stamp_s`` (P,) rising, ``points`` P arrays (N, 2) [m].

    The points are in the sonar's frame, x forward and y to port; ``T_base_sonar`` is where the
    recording says that it sits. ``pixels`` is what images hold by their speckle (None: not
    known), ``pixels_read_as`` what they are taken for, ``db_per_count`` a step of decibels.
    ``tilt_rad`` is how far the middle of the fan looks up or down; the points are projected by it
    already. ``start_s`` is the stamp that seconds are counted from. ``silent_rad`` are bearings,
    rising, at which images never hold anything; they are ``silent_share`` of all beams.
    """

    stamp_s: FloatArray
    points: tuple[FloatArray, ...]
    T_base_sonar: SE2 = SE2()
    pixels: Quantity | None = None
    pixels_read_as: str = "amplitude"
    db_per_count: float = 0.0
    tilt_rad: float = 0.0
    start_s: float = 0.0
    silent_share: float = 0.0
    silent_rad: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if (np.diff(self.stamp_s) < 0.0).any() or len(self.stamp_s) != len(self.points):
            raise InvalidInputError("stamp_s does not rise, or is not as long as points")
