"""What navigation instruments say about a motion: biases, drift, dropouts, disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.vehicles.vehicle import Motion
from uw_dslam_ros2.sim.waters.world import World

__all__ = ["HEADING_SOURCES", "InstrumentConfig", "NavigationLog", "measure", "steel_deflection"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

HEADING_SOURCES = ("gyro", "compass")
"""A gyro's yaw begins anywhere and drifts; a compass' yaw is from north, and steel deflects it."""

_NS = 1_000_000_000
_DEG_PER_HOUR = math.radians(1.0) / 3600.0
_NORTH_RAD = 0.5 * math.pi


@dataclass(frozen=True, slots=True)
class InstrumentConfig(Config):
    """Navigation instruments.

    Gyro figures as in data sheets of MEMS units with temperature calibration, DVL figures as
    those of a Water Linked A50 (1 % of the velocity), pressure of a Keller or Bar30 sensor.
    """

    heading_source: str = setting("gyro", choices=HEADING_SOURCES, doc="what yaw is made of")
    imu_rate_hz: float = setting(25.0, 1.0, 400.0, "IMU messages per second")
    imu_delay_s: float = setting(
        0.0, -5.0, 5.0, "how much later than true the stamps of the IMU are [s]"
    )
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
    compass_offset_rad: float = setting(
        math.radians(2.0), 0.0, 1.0, "sigma of a compass' constant error [rad]"
    )
    compass_deflection_rad: float = setting(
        math.radians(8.0), 0.0, 1.0, "deflection of a compass 3 m off a long steel wall [rad]"
    )
    dvl_rate_hz: float = setting(6.0, 0.5, 50.0, "DVL messages per second")
    dvl_noise_m_s: float = setting(0.006, 0.0, 0.5, "white noise of each velocity [m/s]")
    dvl_scale_sigma: float = setting(0.007, 0.0, 0.1, "sigma of the scale error, 1")
    dvl_bias_m_s: float = setting(0.001, 0.0, 0.1, "sigma of each velocity's bias [m/s]")
    dvl_misalignment_rad: float = setting(
        math.radians(0.3), 0.0, 0.2, "sigma of the mounting angle's error [rad]"
    )
    dvl_dropouts_per_min: float = setting(0.5, 0.0, 30.0, "how often bottom lock is lost [1/min]")
    dvl_dropout_s: float = setting(1.5, 0.0, 60.0, "mean length of a loss [s]")
    dvl_outlier_share: float = setting(
        0.002, 0.0, 0.5, "part of the velocities that are wrong by half a metre per second, 1"
    )
    depth_rate_hz: float = setting(5.0, 0.5, 50.0, "pressure messages per second")
    depth_noise_m: float = setting(0.01, 0.0, 1.0, "white noise of the depth [m]")

    @property
    def yaw_variance(self) -> float:
        """What a driver would claim: it does not know of steel or of drift."""
        offset = self.compass_offset_rad if self.heading_source == "compass" else 0.0
        return float(self.yaw_noise_rad**2 + offset**2)


@dataclass(frozen=True, slots=True, eq=False)
class NavigationLog:
    """What the instruments said. A gyro's zero of yaw is its own, unlike any other's.

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
    config: InstrumentConfig,
    T_base_dvl: SE2,
    rng: np.random.Generator,
    world: World | None = None,
) -> NavigationLog:
    """Sample all instruments along a motion, each with its own clock and errors.

    The place matters to a compass only; without one nothing deflects it.
    """
    imu_stamp_ns = _stamps(motion, config.imu_rate_hz, 0)
    imu = motion.at(imu_stamp_ns - round(config.imu_delay_s * _NS))
    yaw, yaw_rate = _imu_readings(imu, config, rng, world)
    dvl = motion.at(_stamps(motion, config.dvl_rate_hz, 13_000_000))
    depth = motion.at(_stamps(motion, config.depth_rate_hz, 29_000_000))
    return NavigationLog(
        imu_stamp_ns=imu_stamp_ns,
        yaw_rad=yaw,
        yaw_rate_rad_s=yaw_rate,
        dvl_stamp_ns=dvl.stamp_ns,
        dvl_velocity_m_s=_dvl_readings(dvl, config, T_base_dvl, rng),
        depth_stamp_ns=depth.stamp_ns,
        depth_m=depth.depth_m + rng.normal(0.0, config.depth_noise_m, len(depth.depth_m)),
    )


def _stamps(motion: Motion, rate_hz: float, phase_ns: int) -> IntArray:
    first, last = int(motion.stamp_ns[0]) + phase_ns, int(motion.stamp_ns[-1])
    return np.arange(first, last, round(_NS / rate_hz), dtype=np.int64)


def _imu_readings(
    imu: Motion, config: InstrumentConfig, rng: np.random.Generator, world: World | None
) -> tuple[FloatArray, FloatArray]:
    """Yaw and yaw rate: one bias drives both, the yaw integrates it from an unknown start."""
    dt = 1.0 / config.imu_rate_hz
    count = len(imu.stamp_ns)
    start = rng.uniform(-math.pi, math.pi)
    walk = config.gyro_bias_walk_deg_h * math.sqrt(dt / 3600.0)
    bias_deg_h = rng.normal(0.0, config.gyro_bias_deg_h) + np.cumsum(rng.normal(0.0, walk, count))
    bias = bias_deg_h * _DEG_PER_HOUR
    angle_walk = math.radians(config.angle_walk_deg_sqrt_h) * math.sqrt(dt / 3600.0)
    error = start + np.cumsum(bias * dt + rng.normal(0.0, angle_walk, count))
    if config.heading_source == "compass":
        error = np.full(count, rng.normal(0.0, config.compass_offset_rad))
        if world is not None:
            error += config.compass_deflection_rad * steel_deflection(world, imu.poses[:, :2])
    yaw = imu.poses[:, 2] + error + rng.normal(0.0, config.yaw_noise_rad, count)
    rate = imu.yaw_rate_rad_s + bias + rng.normal(0.0, config.gyro_noise_rad_s, count)
    return yaw, rate


def steel_deflection(world: World, points: FloatArray) -> FloatArray:
    """How far (N,) steel nearby turns a compass at points (N, 2) [m]; 1 is 3 m off a long wall.

    Each metre of steel is a dipole along the earth's field: what it adds across the field goes
    with ``sin(2 angle) / distance^3``, the angle of the line of sight from north.
    """
    is_steel = np.array([world.surfaces[i].name == "steel" for i in world.surface_of])
    segments = world.segments[is_steel]
    if len(segments) == 0:
        return np.zeros(len(points))
    centers = 0.5 * (segments[:, :2] + segments[:, 2:])
    lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
    total = np.zeros(len(points))
    for center, length in zip(centers, lengths, strict=True):
        offset = center - points
        distance = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1.0)
        angle = np.arctan2(offset[:, 1], offset[:, 0]) - _NORTH_RAD
        total += min(float(length), 6.0) * np.sin(2.0 * angle) * (3.0 / distance) ** 3
    # The sum is 2 at 3 m off a wall without end that runs north east; very near it saturates.
    return 2.0 * np.tanh(total / 4.0)


def _dvl_readings(
    dvl: Motion, config: InstrumentConfig, T_base_dvl: SE2, rng: np.random.Generator
) -> FloatArray:
    """Velocities (K, 2) at the instrument; NaN where there is no bottom lock."""
    lever = np.column_stack(
        [-T_base_dvl.y * dvl.yaw_rate_rad_s, T_base_dvl.x * dvl.yaw_rate_rad_s]
    )
    misalignment = SE2(yaw=rng.normal(0.0, config.dvl_misalignment_rad))
    at_sensor = (T_base_dvl @ misalignment).inverse().rotation() @ (dvl.velocity_m_s + lever).T
    scale = 1.0 + rng.normal(0.0, config.dvl_scale_sigma)
    bias = rng.normal(0.0, config.dvl_bias_m_s, 2)
    count = len(dvl.stamp_ns)
    velocity = scale * at_sensor.T + bias + rng.normal(0.0, config.dvl_noise_m_s, (count, 2))
    is_outlier = rng.random(count) < config.dvl_outlier_share
    velocity[is_outlier] += rng.normal(0.0, 0.5, (int(is_outlier.sum()), 2))
    begins = rng.random(count) < config.dvl_dropouts_per_min / 60.0 / config.dvl_rate_hz
    for i in np.flatnonzero(begins):
        length = round(rng.exponential(config.dvl_dropout_s) * config.dvl_rate_hz)
        velocity[i : i + max(1, length)] = np.nan
    return velocity
