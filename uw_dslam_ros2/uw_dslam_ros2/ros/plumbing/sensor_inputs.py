"""Which topics a mapper reads, and what their messages become."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from marine_acoustic_msgs.msg import Dvl, ProjectedSonarImage
from sensor_msgs.msg import FluidPressure, Imu, LaserScan, PointCloud2

from uw_dslam_ros2.io import messages
from uw_dslam_ros2.io.drivers.laser_scan import read_scan
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.feeding import SensorEvent
from uw_dslam_ros2.io.readings import (
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    VelocityEvent,
)
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig

__all__ = ["SensorInput", "sensor_inputs"]

_PING_QUEUE = 100
"""Pings kept while the mapper is busy: ten seconds at 10 Hz, and an image is large."""
_SENSOR_QUEUE = 5000
"""Other messages kept meanwhile: half a minute of a fast IMU; nearly nothing in memory."""


@dataclass(frozen=True, slots=True)
class SensorInput:
    """One topic; ``to_event`` gives None for a message without a value (no bottom lock)."""

    msg_type: Any
    topic: str
    to_event: Callable[[Any], SensorEvent | None]
    queue_depth: int


def sensor_inputs(config: SonarMapperConfig, vehicle_id: str) -> tuple[SensorInput, ...]:
    """Pings, velocity, heading and depth, as the settings name them."""
    reader = _Reader(config, vehicle_id)
    ping_type, ping_topic, to_event = {
        "any": (ProjectedSonarImage, "sonar", reader.image),
        "image": (ProjectedSonarImage, "sonar", reader.image),
        "scan": (LaserScan, "scan", reader.scan),
        "points": (PointCloud2, "points", reader.points),
    }[config.input]
    velocity_type = Dvl if config.velocity != "twist" else TwistWithCovarianceStamped
    return (
        SensorInput(
            ping_type,
            ping_topic,
            to_event,
            # A scan may hold a single beam.
            _SENSOR_QUEUE if ping_type is LaserScan else _PING_QUEUE,
        ),
        SensorInput(velocity_type, "dvl", reader.velocity, _SENSOR_QUEUE),
        SensorInput(Imu, "imu", reader.imu, _SENSOR_QUEUE),
        SensorInput(FluidPressure, "depth", reader.depth, _SENSOR_QUEUE),
    )


class _Reader:
    """Makes events of messages."""

    def __init__(self, config: SonarMapperConfig, vehicle_id: str) -> None:
        self._config = config
        self._vehicle_id = vehicle_id

    def _key(self, msg: Any) -> tuple[str, int, str]:
        return self._vehicle_id, messages.stamp_of(msg), msg.header.frame_id

    def image(self, msg: Any) -> SensorEvent:
        """A sonar image."""
        image = messages.sonar_image_of(msg, self._config.data_order)
        return ImageEvent(*self._key(msg), image)

    def scan(self, msg: Any) -> SensorEvent | None:
        """Ranges over angles: of one moment, or beams with times of their own."""
        return next(iter(read_scan(msg, ReadSettings(vehicle_id=self._vehicle_id))), None)

    def points(self, msg: Any) -> SensorEvent:
        """Echoes that somebody else found."""
        return PointsEvent(*self._key(msg), messages.points_of_cloud(msg))

    def imu(self, msg: Any) -> SensorEvent:
        """Yaw and yaw rate."""
        return ImuEvent(*self._key(msg), *messages.readings_of_imu(msg))

    def depth(self, msg: Any) -> SensorEvent:
        """Pressure as depth."""
        depth_m = messages.depth_of_pressure(msg, self._config.water_density_kg_m3)
        return DepthEvent(*self._key(msg), depth_m)

    def velocity(self, msg: Any) -> SensorEvent | None:
        """Velocity over ground; None without bottom lock."""
        is_dvl = self._config.velocity != "twist"
        value = messages.velocity_of_dvl(msg) if is_dvl else messages.velocity_of_twist(msg)
        if value is None:
            return None
        return VelocityEvent(*self._key(msg), *value, is_z_down=is_dvl)
