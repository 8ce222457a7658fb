"""What one vehicle's instruments say of its motion, and where it is by that."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.navigation import FilterState, NavigationConfig, NavigationFilter
from uw_dslam_ros2.core.navigation.pose_differences import PoseDifferences
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["VehicleNavigation"]

FloatArray = NDArray[np.float64]
_ATTITUDE_NS = 500_000_000
"""A vehicle rolls and pitches within seconds: older angles are not used."""


class VehicleNavigation:
    """Dead reckoning of one vehicle; every input is a method call with a stamp in nanoseconds."""

    def __init__(self, config: NavigationConfig) -> None:
        self._navigation = NavigationFilter(config)
        # Matches of pings move the one; what instruments alone say is kept for the last pass.
        self._dead_reckoning: NavigationFilter | None = NavigationFilter(config)
        self._velocity_ns: int | None = None
        self._pose_differences = PoseDifferences()
        self._attitude: tuple[int, FloatArray | None] = (0, None)
        self._depth_m = math.nan

    # --- in ------------------------------------------------------------------------------------

    def add_imu(
        self,
        stamp_ns: int,
        yaw_rad: float | None,
        yaw_rate_rad_s: float | None,
        yaw_sigma_rad: float | None = None,
    ) -> None:
        """Yaw and yaw rate of base_link, counter-clockwise; None where not measured.

        Yaw may have an unknown constant offset.
        """
        if yaw_rate_rad_s is not None:
            for navigation in self._filters:
                navigation.add_yaw_rate(stamp_ns, yaw_rate_rad_s)
        if yaw_rad is not None:
            for navigation in self._filters:
                navigation.add_yaw(stamp_ns, yaw_rad, yaw_sigma_rad)

    def add_velocity(
        self,
        stamp_ns: int,
        v_body_m_s: ArrayLike,
        covariance: ArrayLike | None = None,
        T_base_sensor: SE2 = SE2(),
    ) -> None:
        """Velocity (2,) along the instrument's axes (forward, left) with covariance (2, 2)."""
        for navigation in self._filters:
            navigation.add_velocity(stamp_ns, v_body_m_s, covariance, T_base_sensor)
        if np.isfinite(np.asarray(v_body_m_s, dtype=np.float64)).all():
            self._velocity_ns = max(stamp_ns, self._velocity_ns or stamp_ns)

    def add_pose(self, stamp_ns: int, T_frame_base: SE2) -> None:
        """Pose that the vehicle's own filter gives; only the motion between poses is used."""
        self._dead_reckoning = None  # see `dead_reckoning_at`
        for navigation in self._filters:
            navigation.add_yaw(stamp_ns, T_frame_base.yaw)
        if (difference := self._pose_differences.add(stamp_ns, T_frame_base)) is not None:
            self.add_velocity(*difference)

    def add_attitude(self, stamp_ns: int, R_level_base: FloatArray | None) -> None:
        """Roll and pitch (3, 3), from base_link to the level frame of the same yaw."""
        self._attitude = (stamp_ns, R_level_base)

    def add_depth(self, stamp_ns: int, depth_m: float) -> None:  # noqa: ARG002 (one form for all inputs)
        """Depth below the surface [m], positive down.

        Kept for the diagnostics: the map is flat.
        """
        if math.isfinite(depth_m):
            self._depth_m = float(depth_m)

    # --- out -----------------------------------------------------------------------------------

    @property
    def is_started(self) -> bool:
        """Whether there is a pose."""
        return self._navigation.is_started

    @property
    def stamp_ns(self) -> int | None:
        """Time of the newest navigation message; None before the first."""
        return self._navigation.stamp_ns

    @property
    def T_smooth_base(self) -> SE2:  # noqa: N802 (a motion)
        """Where the vehicle is now, in a frame that loop closures do not move: it drifts.

        Raises `InvalidInputError` before the first navigation message.
        """
        return self._navigation.pose_at(self._now_ns())[0]

    @property
    def smooth_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `T_smooth_base`, order x, y, yaw."""
        return self._navigation.pose_at(self._now_ns())[1]

    @property
    def velocity(self) -> tuple[FloatArray, float]:
        """Body velocity (2,) [m/s] over ground and yaw rate [rad/s] now."""
        return self._navigation.velocity_at(self._now_ns())

    @property
    def velocity_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `velocity`: forward, left [m/s], yaw rate [rad/s]."""
        return self._navigation.velocity_covariance_at(self._now_ns())

    @property
    def depth_m(self) -> float:
        """Depth below the surface as last measured; NaN where it is not."""
        return self._depth_m

    def dead_reckoning_at(self, stamp_ns: int) -> SE2 | None:
        """Where the vehicle is by its instruments alone, in a frame that drifts.

        None where its own filter gives poses: what those are wrong by is not a scale and a drift.
        """
        if self._dead_reckoning is None:
            return None
        return self._dead_reckoning.pose_at(stamp_ns)[0]

    def velocity_silence_s(self, stamp_ns: int) -> float:
        """For how long there has been no velocity [s]; infinity before the first."""
        if self._velocity_ns is None:
            return math.inf
        return max(0.0, (stamp_ns - self._velocity_ns) * 1e-9)

    def attitude_at(self, stamp_ns: int) -> FloatArray | None:
        """Roll and pitch (3, 3) as last measured; None where that is not known or long ago."""
        measured_ns, R_level_base = self._attitude
        return R_level_base if abs(stamp_ns - measured_ns) <= _ATTITUDE_NS else None

    def navigation_diagnostics(self) -> dict[str, float | int | str]:
        """Counters and the filter's beliefs, by name."""
        navigation = self._navigation
        newest_ns = navigation.stamp_ns
        age_s = math.nan
        if newest_ns is not None and self._velocity_ns is not None:
            age_s = (newest_ns - self._velocity_ns) * 1e-9
        return {
            "depth_m": self._depth_m,
            "velocity_age_s": age_s,
            "num_navigation_late": navigation.num_late,
            "num_navigation_invalid": navigation.num_invalid,
            "num_navigation_outliers": navigation.num_outliers,
            **navigation.counts(),
            **navigation.sensor_errors(),
        }

    @property
    def _filters(self) -> tuple[NavigationFilter, ...]:
        if self._dead_reckoning is None:
            return (self._navigation,)
        return self._navigation, self._dead_reckoning

    def _resume_navigation(
        self, state: FilterState, dead_reckoning: FilterState | None, velocity_ns: int | None
    ) -> None:
        self._navigation.resume(state)
        self._velocity_ns = velocity_ns
        if self._dead_reckoning is None or dead_reckoning is None:
            self._dead_reckoning = None
        else:
            self._dead_reckoning.resume(dead_reckoning)

    def _remember(self, span_s: float) -> None:
        """Know poses for so long; see `NavigationFilter.remember`."""
        for navigation in self._filters:
            navigation.remember(span_s)

    def _now_ns(self) -> int:
        """Raises `InvalidInputError` before the first navigation message."""
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no pose yet, expected navigation messages first")
        return stamp_ns
