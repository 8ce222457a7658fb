"""A vehicle on its route."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["DriveConfig", "Motion", "drive"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NS = 1_000_000_000
_MAX_CRAB = 0.5  # sine of the angle at which the vehicle gives in to the current


@dataclass(frozen=True, slots=True)
class DriveConfig(Config):
    """How a vehicle moves; the defaults resemble a small inspection vehicle."""

    speed_m_s: float = setting(1.0, 0.1, 3.0, "cruising speed [m/s]")
    max_yaw_rate_rad_s: float = setting(0.3, 0.02, 2.0, "it slows down in bends for this [rad/s]")
    depth_m: float = setting(3.0, 0.5, 100.0, "cruising depth [m]")
    current_m_s: float = setting(0.1, 0.0, 1.0, "speed of the water over ground [m/s]")
    current_yaw_rad: float = setting(0.7, -math.pi, math.pi, "where the water flows to [rad]")


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """True motion of base_link at times ``stamp_ns`` (K,), evenly spaced.

    ``poses`` (K, 3) [x, y, yaw] in the world with yaw not wrapped, ``velocity_m_s`` (K, 2) in
    body axes (FLU), ``yaw_rate_rad_s`` (K,), ``depth_m`` (K,).
    """

    stamp_ns: IntArray
    poses: FloatArray
    velocity_m_s: FloatArray
    yaw_rate_rad_s: FloatArray
    depth_m: FloatArray

    def at(self, stamp_ns: IntArray) -> Motion:
        """Linear interpolation at other times, held constant beyond the ends."""
        t = (np.asarray(stamp_ns) - self.stamp_ns[0]).astype(np.float64)
        known = (self.stamp_ns - self.stamp_ns[0]).astype(np.float64)

        def columns(values: FloatArray) -> FloatArray:
            return np.column_stack([np.interp(t, known, column) for column in values.T])

        return Motion(
            np.asarray(stamp_ns, dtype=np.int64),
            columns(self.poses),
            columns(self.velocity_m_s),
            np.interp(t, known, self.yaw_rate_rad_s),
            np.interp(t, known, self.depth_m),
        )

    def pose(self, index: int) -> SE2:
        """``T_world_base`` of one sample."""
        return SE2.from_array(self.poses[index])


def drive(
    route: FloatArray,
    start_ns: int,
    duration_s: float,
    config: DriveConfig,
    rng: np.random.Generator,
    rate_hz: float = 50.0,
) -> Motion:
    """Follow a route (N, 2) [m] for some time; slower in bends, its bow into the current.

    Raises
    ------
    InvalidInputError
        If the route ends before the time does.
    """
    num_samples = math.ceil(duration_s * rate_hz) + 1
    s, headings, speeds = _profile(route, config, rng)
    times = np.concatenate([[0.0], np.cumsum(np.diff(s) * 2.0 / (speeds[1:] + speeds[:-1]))])
    if times[-1] < duration_s:
        raise InvalidInputError(
            f"the route is {s[-1]:.0f} m long and ends after {times[-1]:.0f} s, "
            f"expected at least {duration_s:.0f} s"
        )
    t = np.arange(num_samples) / rate_hz
    progress = np.interp(t, times, s)
    # Half a second of inertia, and so smooth derivatives.
    progress = gaussian_filter1d(progress, 0.5 * rate_hz, mode="nearest")
    x, y = CubicSpline(s, route, axis=0)(progress).T
    crab = 0.04 * np.sin(2.0 * math.pi * t / rng.uniform(11.0, 19.0) + rng.uniform(0.0, 6.0))
    crab += _crab_angle(np.interp(progress, s, headings), config)
    yaw = crab + gaussian_filter1d(np.interp(progress, s, headings), 0.3 * rate_hz, mode="nearest")
    v_world = np.gradient(np.column_stack([x, y]), 1.0 / rate_hz, axis=0)
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward = cos * v_world[:, 0] + sin * v_world[:, 1]
    left = -sin * v_world[:, 0] + cos * v_world[:, 1]
    heave = 0.1 * np.sin(2.0 * math.pi * t / rng.uniform(20.0, 40.0) + rng.uniform(0.0, 6.0))
    return Motion(
        stamp_ns=start_ns + np.rint(t * _NS).astype(np.int64),
        poses=np.column_stack([x, y, yaw]),
        velocity_m_s=np.column_stack([forward, left]),
        yaw_rate_rad_s=np.gradient(yaw, 1.0 / rate_hz),
        depth_m=config.depth_m + heave,
    )


def _crab_angle(headings: FloatArray, config: DriveConfig) -> FloatArray:
    """Angle (K,) [rad] by which the bow turns into the current, so that the course is held."""
    across = config.current_m_s * np.sin(config.current_yaw_rad - headings)
    return -np.arcsin(np.clip(across / config.speed_m_s, -_MAX_CRAB, _MAX_CRAB))


def _profile(
    route: FloatArray, config: DriveConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arc length (N,) [m], heading (N,) [rad] and speed (N,) [m/s] along a route.

    The heading is the course, smoothed: where the route turns back on itself the vehicle slows
    down and turns while it drifts on, as one with thrusters on all sides does.
    """
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    course = np.unwrap(np.arctan2(*np.gradient(route, s, axis=0).T[::-1]))
    headings = gaussian_filter1d(course, 1.2 / s[1], mode="nearest")
    turn = np.abs(np.gradient(headings, s))
    whim = 1.0 + 0.1 * np.sin(2.0 * math.pi * s / rng.uniform(20.0, 50.0) + rng.uniform(0.0, 6.0))
    limit = config.max_yaw_rate_rad_s / np.maximum(turn, 1e-9)
    speeds = np.minimum(config.speed_m_s * whim, limit)
    # It brakes before the bend: the smooth speed never exceeds the limit.
    window = math.ceil(0.5 / s[1])
    speeds = minimum_filter1d(speeds, 4 * window + 1, mode="nearest")
    return s, headings, gaussian_filter1d(speeds, window, truncate=2.0, mode="nearest")
