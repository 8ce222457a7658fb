"""One vehicle's bag: topics, types and frames as the nodes expect them."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.config import SonarConfig
from uw_dslam_ros2.core.sonar.detect import image_echoes
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.recordings import BagWriter
from uw_dslam_ros2.sim.missions.mission import (
    SONAR_HEIGHT_M,
    T_BASE_DVL,
    T_BASE_SONAR,
    Mission,
    VehicleRun,
)
from uw_dslam_ros2.sim.sonars.space_sonar import SpacePing
from uw_dslam_ros2.sim.sonars.turning import counted_rad
from uw_dslam_ros2.sim.vehicles.sway import body_rates, rotation_level_base

__all__ = ["TRUTH_STEP", "VehicleRecorder"]

_FREQUENCY_HZ = 1.2e6
_SOUND_SPEED_M_S = 1500.0
TRUTH_STEP = 5
"""The true motion is recorded at every fifth of its 50 samples per second."""

# Quaternions [x, y, z, w] of frames in base_link: the sonar's z forward, x up, y to starboard;
# the DVL's x forward, z down.
_SONAR_ROTATION = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
_DVL_ROTATION = (1.0, 0.0, 0.0, 0.0)
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
_HEAVE_NS = 100_000_000

_Quaternion = tuple[float, float, float, float]


class VehicleRecorder:
    """Writes one vehicle's bag in order of time."""

    def __init__(self, writer: BagWriter, run: VehicleRun, mission: Mission) -> None:
        self._writer = writer
        self._make = MessageFactory(writer.typestore)
        self._run = run
        self._config = mission.config
        self._water_depth_m = mission.world.water_depth_m
        who = run.vehicle_id
        self._base, self._sonar = f"{who}/base_link", f"{who}/sonar"
        writer.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
        self._beams: list[SonarImage] = []
        self._num_beams = 0
        self._turning_topic = f"/{who}/scan"
        if self._config.is_turning:
            is_cloud = self._config.turning.message == "points"
            kind = "PointCloud2" if is_cloud else "LaserScan"
            writer.add_topic(self._turning_topic, f"sensor_msgs/msg/{kind}")
        elif self._config.sonar_kind == "space":
            writer.add_topic(f"/{who}/sonar", "sensor_msgs/msg/PointCloud2")
        else:
            writer.add_topic(f"/{who}/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        writer.add_topic(f"/{who}/imu", "sensor_msgs/msg/Imu")
        writer.add_topic(f"/{who}/dvl", "marine_acoustic_msgs/msg/Dvl")
        writer.add_topic(f"/{who}/depth", "sensor_msgs/msg/FluidPressure")
        writer.add_topic(f"/{who}/truth/odom", "nav_msgs/msg/Odometry")
        start_ns = int(run.motion.stamp_ns[0])
        self._writer.write("/tf_static", start_ns, self._mounts(start_ns))
        log = run.navigation
        events = itertools.chain(
            ((int(t), 0, i) for i, t in enumerate(log.imu_stamp_ns)),
            ((int(t), 1, i) for i, t in enumerate(log.dvl_stamp_ns)),
            ((int(t), 2, i) for i, t in enumerate(log.depth_stamp_ns)),
            (
                (int(run.motion.stamp_ns[i]), 3, i)
                for i in range(0, len(run.motion.stamp_ns), TRUTH_STEP)
            ),
        )
        self._pending = sorted(events, reverse=True)
        self._writers = (self._write_imu, self._write_dvl, self._write_depth, self._write_truth)

    def _mounts(self, stamp_ns: int) -> Any:
        who = self._run.vehicle_id
        # The axes of scans and points are x ahead, y to port.
        is_imaging = self._config.sonar_kind == "imaging"
        rotation = _SONAR_ROTATION if is_imaging else _NO_ROTATION
        if tilt_rad := self._config.sway.sonar_tilt_rad:
            rotation = _tilted(rotation, tilt_rad)
        mounts = [
            (f"{who}/sonar", (T_BASE_SONAR.x, T_BASE_SONAR.y, SONAR_HEIGHT_M), rotation),
            (f"{who}/dvl", (T_BASE_DVL.x, T_BASE_DVL.y, -0.15), _DVL_ROTATION),
            (f"{who}/imu", (0.0, 0.0, 0.0), _NO_ROTATION),
            (f"{who}/depth", (0.0, 0.0, 0.0), _NO_ROTATION),
        ]
        return self._make.transforms(stamp_ns, self._base, mounts)

    def write_until(self, stamp_ns: int | None) -> None:
        """Write everything but images up to a time; None means all that is left."""
        while self._pending and (stamp_ns is None or self._pending[-1][0] <= stamp_ns):
            stamp, kind, index = self._pending.pop()
            self._writers[kind](stamp, index)

    def write_ping(self, image: SonarImage | SpacePing) -> None:
        """Write one ping; of a sonar that turns, once its message is complete."""
        if isinstance(image, SpacePing):
            message = self._make.points(image.stamp_ns, self._sonar, image.points)
            self._writer.write(f"/{self._run.vehicle_id}/sonar", image.stamp_ns, message)
            return
        if not self._config.is_turning:
            self._write_image(image)
            return
        self._beams.append(image)
        turning = self._config.turning
        if len(self._beams) < (1 if turning.message == "beam" else turning.num_beams):
            return
        if turning.message == "points":
            self._write_points(self._beams)
        else:
            self._write_scan(self._beams)
        self._num_beams += len(self._beams)
        self._beams = []

    def _ranges(self, beams: list[SonarImage]) -> NDArray[np.float64]:
        """First echoes, as a driver finds them; infinity where there is none."""
        ranges = np.full(len(beams), np.inf)
        for i, beam in enumerate(beams):
            found = image_echoes(beam, SonarConfig())
            if len(found.range_m):
                ranges[i] = found.range_m[0]
        return ranges

    def _write_scan(self, beams: list[SonarImage]) -> None:
        """Stamped with the first beam's time."""
        turning = self._config.turning
        step_rad = 2.0 * math.pi / turning.num_beams
        message = self._make.laser_scan(
            beams[0].stamp_ns,
            self._sonar,
            angle_min_rad=counted_rad(turning, float(beams[0].bearing_rad[0])),
            angle_increment_rad=-step_rad if turning.is_clockwise else step_rad,
            time_increment_s=turning.interval_s,
            ranges_m=self._ranges(beams),
            range_limits_m=(self._config.sonar.min_range_m, turning.max_range_m),
        )
        self._writer.write(self._turning_topic, beams[-1].stamp_ns, message)

    def _write_points(self, beams: list[SonarImage]) -> None:
        """Echoes of a turn as heard from the sonar's true place in its middle."""
        turning, middle = self._config.turning, len(beams) // 2
        motion, T_base_sonar = self._run.ping_motion, self._run.T_base_sonar
        T_middle_map = (motion.pose(self._num_beams + middle) @ T_base_sonar).inverse()
        ranges = self._ranges(beams)
        points = []
        for i in np.flatnonzero(np.isfinite(ranges)):
            T_middle_sonar = T_middle_map @ motion.pose(self._num_beams + int(i)) @ T_base_sonar
            bearing = float(beams[i].bearing_rad[0])
            echo = (ranges[i] * math.cos(bearing), ranges[i] * math.sin(bearing))
            points.append(T_middle_sonar.apply(np.array([echo]))[0])
        seen = SE2(yaw=-turning.zero_rad).apply(np.array(points).reshape(-1, 2))
        seen[:, 1] *= -1.0 if turning.is_clockwise else 1.0
        message = self._make.points(beams[middle].stamp_ns, self._sonar, seen)
        self._writer.write(self._turning_topic, beams[-1].stamp_ns, message)

    def _write_image(self, image: SonarImage) -> None:
        message = self._make.sonar_image(
            self._sonar,
            image,
            beam_width_rad=self._config.sonar.beam_width_rad,
            frequency_hz=_FREQUENCY_HZ,
            sound_speed_m_s=_SOUND_SPEED_M_S,
        )
        self._writer.write(f"/{self._run.vehicle_id}/sonar", image.stamp_ns, message)

    def _write_imu(self, stamp_ns: int, index: int) -> None:
        log, instruments = self._run.navigation, self._config.instruments
        message = self._make.imu(
            stamp_ns,
            f"{self._run.vehicle_id}/imu",
            float(log.yaw_rad[index]),
            instruments.yaw_variance,
            float(log.yaw_rate_rad_s[index]),
            instruments.gyro_noise_rad_s**2,
        )
        if not self._config.sway.is_steady:
            sway = self._config.sway.at(stamp_ns - round(instruments.imu_delay_s * 1e9))
            message.orientation = self._make.quaternion(
                _leaning_quaternion(sway[0], sway[1], float(log.yaw_rad[index]))
            )
            rates = body_rates(sway, float(log.yaw_rate_rad_s[index]))
            message.angular_velocity = self._make.vector(*rates)
        self._writer.write(f"/{self._run.vehicle_id}/imu", stamp_ns, message)

    def _write_dvl(self, stamp_ns: int, index: int) -> None:
        velocity = self._run.navigation.dvl_velocity_m_s[index]
        motion = self._run.motion
        if not self._config.sway.is_steady:
            velocity = self._leaning(stamp_ns, velocity)
        message = self._make.dvl(
            stamp_ns,
            f"{self._run.vehicle_id}/dvl",
            velocity if np.isfinite(velocity).all() else None,
            self._config.instruments.dvl_noise_m_s**2,
            self._water_depth_m - float(np.interp(stamp_ns, motion.stamp_ns, motion.depth_m)),
        )
        self._writer.write(f"/{self._run.vehicle_id}/dvl", stamp_ns, message)

    def _leaning(self, stamp_ns: int, velocity_m_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Velocity (3,) along the axes of a vehicle that leans, of one in its level frame."""
        motion = self._run.motion
        around = np.array([stamp_ns - _HEAVE_NS, stamp_ns + _HEAVE_NS])
        depth_m = np.interp(around, motion.stamp_ns, motion.depth_m)
        up_m_s = float(depth_m[0] - depth_m[1]) / (2e-9 * _HEAVE_NS)
        R_level_base = rotation_level_base(*self._config.sway.at(stamp_ns)[:2])
        return np.asarray(R_level_base.T @ np.append(velocity_m_s, up_m_s))

    def _write_depth(self, stamp_ns: int, index: int) -> None:
        message = self._make.pressure(
            stamp_ns,
            f"{self._run.vehicle_id}/depth",
            float(self._run.navigation.depth_m[index]),
            self._config.instruments.depth_noise_m,
        )
        self._writer.write(f"/{self._run.vehicle_id}/depth", stamp_ns, message)

    def _write_truth(self, stamp_ns: int, index: int) -> None:
        motion = self._run.motion
        message = self._make.odometry(
            stamp_ns,
            "map",
            self._base,
            motion.pose(index),
            float(motion.depth_m[index]),
            motion.velocity_m_s[index],
            float(motion.yaw_rate_rad_s[index]),
        )
        self._writer.write(f"/{self._run.vehicle_id}/truth/odom", stamp_ns, message)


def _leaning_quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> _Quaternion:
    """Orientation [x, y, z, w]: roll about x, then pitch about y, then yaw about z."""
    sin, cos = math.sin(0.5 * roll_rad), math.cos(0.5 * roll_rad)
    x, y, z, w = _tilted((sin, 0.0, 0.0, cos), pitch_rad)
    sin, cos = math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)
    return cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z


def _tilted(rotation: _Quaternion, tilt_rad: float) -> _Quaternion:
    """A quaternion [x, y, z, w] turned about the y axis to port: bow down."""
    x, y, z, w = rotation
    sin, cos = math.sin(0.5 * tilt_rad), math.cos(0.5 * tilt_rad)
    return cos * x + sin * z, cos * y + sin * w, cos * z - sin * x, cos * w - sin * y
