"""A vehicle on its route, and what its navigation instruments say about that."""

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

__all__ = ["Motion", "NavigationConfig", "NavigationLog", "drive", "measure"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NS = 1_000_000_000
_DEG_PER_HOUR = math.radians(1.0) / 3600.0


@dataclass(frozen=True, slots=True)
class NavigationConfig(Config):
    """Motion and navigation instruments; the defaults resemble a small inspection vehicle.

    Gyro figures as in data sheets of MEMS units with temperature calibration, DVL figures as
    those of a Water Linked A50 (1 % of the velocity), pressure of a Keller or Bar30 sensor.
    """

    speed_m_s: float = setting(1.0, 0.1, 3.0, "cruising speed [m/s]")
    max_yaw_rate_rad_s: float = setting(0.3, 0.02, 2.0, "it slows down in bends for this [rad/s]")
    depth_m: float = setting(3.0, 0.5, 100.0, "cruising depth [m]")
    imu_rate_hz: float = setting(25.0, 1.0, 400.0, "IMU messages per second")
    yaw_noise_rad: float = setting(math.radians(0.15), 0.0, 0.5, "white noise of the yaw [rad]")
    gyro_noise_rad_s: float = setting(1.0e-3, 0.0, 0.1, "white noise of the yaw rate [rad/s]")
    gyro_bias_deg_h: float = setting(
        20.0, 0.0, 1000.0, "sigma of the gyro's bias at the start, in both yaw and rate [deg/h]"
    )
    gyro_bias_walk_deg_h: float = setting(
        15.0, 0.0, 1000.0, "sigma of the bias' change in an hour of random walk [deg/h]"
    )
    angle_walk_deg_sqrt_h: float = setting(
        0.3, 0.0, 20.0, "angle random walk of the yaw [deg / sqrt(h)]"
    )
    dvl_rate_hz: float = setting(6.0, 0.5, 50.0, "DVL messages per second")
    dvl_noise_m_s: float = setting(0.006, 0.0, 0.5, "white noise of each velocity [m/s]")
    dvl_scale_sigma: float = setting(0.007, 0.0, 0.1, "sigma of the scale error, 1")
    dvl_bias_m_s: float = setting(0.001, 0.0, 0.1, "sigma of each velocity's bias [m/s]")
    dvl_misalignment_rad: float = setting(
        math.radians(0.3), 0.0, 0.2, "sigma of the mounting angle's error [rad]"
    )
    depth_rate_hz: float = setting(5.0, 0.5, 50.0, "pressure messages per second")
    depth_noise_m: float = setting(0.01, 0.0, 1.0, "white noise of the depth [m]")


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
    config: NavigationConfig,
    rng: np.random.Generator,
    rate_hz: float = 50.0,
) -> Motion:
    """Follow a route (N, 2) [m] for some time; slower in bends, crabbing a little.

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


def _profile(
    route: FloatArray, config: NavigationConfig, rng: np.random.Generator
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


@dataclass(frozen=True, slots=True, eq=False)
class NavigationLog:
    """What the instruments said. The yaw's zero is the instrument's own, unlike any other's.

    ``dvl_velocity_m_s`` (K, 2) in FLU axes at the instrument; NaN where bottom lock was lost.
    """

    imu_stamp_ns: IntArray
    yaw_rad: FloatArray
    yaw_rate_rad_s: FloatArray
    dvl_stamp_ns: IntArray
    dvl_velocity_m_s: FloatArray
    depth_stamp_ns: IntArray
    depth_m: FloatArray


def measure(
    motion: Motion,
    config: NavigationConfig,
    T_base_dvl: SE2,
    rng: np.random.Generator,
) -> NavigationLog:
    """Sample all instruments along a motion, each with its own clock and errors."""
    imu = motion.at(_stamps(motion, config.imu_rate_hz, 0))
    yaw, yaw_rate = _imu_readings(imu, config, rng)
    dvl = motion.at(_stamps(motion, config.dvl_rate_hz, 13_000_000))
    lever = np.column_stack(
        [-T_base_dvl.y * dvl.yaw_rate_rad_s, T_base_dvl.x * dvl.yaw_rate_rad_s]
    )
    misalignment = SE2(yaw=rng.normal(0.0, config.dvl_misalignment_rad))
    at_sensor = (T_base_dvl @ misalignment).inverse().rotation() @ (dvl.velocity_m_s + lever).T
    scale = 1.0 + rng.normal(0.0, config.dvl_scale_sigma)
    bias = rng.normal(0.0, config.dvl_bias_m_s, 2)
    noise = rng.normal(0.0, config.dvl_noise_m_s, dvl.velocity_m_s.shape)
    depth = motion.at(_stamps(motion, config.depth_rate_hz, 29_000_000))
    return NavigationLog(
        imu_stamp_ns=imu.stamp_ns,
        yaw_rad=yaw,
        yaw_rate_rad_s=yaw_rate,
        dvl_stamp_ns=dvl.stamp_ns,
        dvl_velocity_m_s=scale * at_sensor.T + bias + noise,
        depth_stamp_ns=depth.stamp_ns,
        depth_m=depth.depth_m + rng.normal(0.0, config.depth_noise_m, len(depth.depth_m)),
    )


def _stamps(motion: Motion, rate_hz: float, phase_ns: int) -> IntArray:
    first, last = int(motion.stamp_ns[0]) + phase_ns, int(motion.stamp_ns[-1])
    return np.arange(first, last, round(_NS / rate_hz), dtype=np.int64)


def _imu_readings(
    imu: Motion, config: NavigationConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Yaw and yaw rate: one bias drives both, the yaw integrates it from an unknown start."""
    dt = 1.0 / config.imu_rate_hz
    count = len(imu.stamp_ns)
    offset = rng.uniform(-math.pi, math.pi)
    walk = config.gyro_bias_walk_deg_h * math.sqrt(dt / 3600.0)
    bias_deg_h = rng.normal(0.0, config.gyro_bias_deg_h) + np.cumsum(rng.normal(0.0, walk, count))
    bias = bias_deg_h * _DEG_PER_HOUR
    angle_walk = math.radians(config.angle_walk_deg_sqrt_h) * math.sqrt(dt / 3600.0)
    drift = np.cumsum(bias * dt + rng.normal(0.0, angle_walk, count))
    yaw = imu.poses[:, 2] + offset + drift + rng.normal(0.0, config.yaw_noise_rad, count)
    rate = imu.yaw_rate_rad_s + bias + rng.normal(0.0, config.gyro_noise_rad_s, count)
    return yaw, rate
