"""Which topics a mapper reads, and what their messages become."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from marine_acoustic_msgs.msg import Dvl, ProjectedSonarImage
from sensor_msgs.msg import FluidPressure, Imu, LaserScan, PointCloud2

from uw_dslam_ros2.io import messages
from uw_dslam_ros2.io.events import (
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    ScanEvent,
    VelocityEvent,
)
from uw_dslam_ros2.io.feeding import SensorEvent
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig

__all__ = ["SensorInput", "sensor_inputs"]


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
        "image": (ProjectedSonarImage, "sonar", reader.image),
        "scan": (LaserScan, "scan", reader.scan),
        "points": (PointCloud2, "points", reader.points),
    }[config.input]
    velocity_type = Dvl if config.velocity == "dvl" else TwistWithCovarianceStamped
    return (
        SensorInput(ping_type, ping_topic, to_event, config.ping_queue),
        SensorInput(velocity_type, "dvl", reader.velocity, config.sensor_queue),
        SensorInput(Imu, "imu", reader.imu, config.sensor_queue),
        SensorInput(FluidPressure, "depth", reader.depth, config.sensor_queue),
    )


class _Reader:
    """Makes events of messages."""

    def __init__(self, config: SonarMapperConfig, vehicle_id: str) -> None:
        self._config = config
        self._vehicle_id = vehicle_id

    def _key(self, msg: Any) -> tuple[str, int, str]:
        return self._vehicle_id, messages.stamp_of(msg), msg.header.frame_id

    def image(self, msg: Any) -> SensorEvent:
        image = messages.sonar_image_of(msg, self._config.data_order)
        return ImageEvent(*self._key(msg), image)

    def scan(self, msg: Any) -> SensorEvent:
        return ScanEvent(*self._key(msg), *messages.scan_of_laser_scan(msg))

    def points(self, msg: Any) -> SensorEvent:
        return PointsEvent(*self._key(msg), messages.points_of_cloud(msg))

    def imu(self, msg: Any) -> SensorEvent:
        return ImuEvent(*self._key(msg), *messages.yaw_of_imu(msg))

    def depth(self, msg: Any) -> SensorEvent:
        depth_m = messages.depth_of_pressure(msg, self._config.water_density_kg_m3)
        return DepthEvent(*self._key(msg), depth_m)

    def velocity(self, msg: Any) -> SensorEvent | None:
        is_dvl = self._config.velocity == "dvl"
        value = messages.velocity_of_dvl(msg) if is_dvl else messages.velocity_of_twist(msg)
        return None if value is None else VelocityEvent(*self._key(msg), *value)
