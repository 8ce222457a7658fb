"""What drivers publish, by the name of the message's type; nothing need be installed for it."""

from uw_dslam_ros2.io.drivers import (
    dvl,
    fix,
    image,
    imu,
    laser_scan,
    oculus,
    odometry,
    ping360,
    point_cloud,
    pressure,
    projected_image,
    twist,
)
from uw_dslam_ros2.io.drivers.adapter import Adapter, stamp_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings

__all__ = ["ADAPTERS", "Adapter", "ReadSettings", "adapter_of", "stamp_of"]

_FAMILIES = (
    projected_image, oculus, ping360, laser_scan, point_cloud, image,
    dvl, twist, imu, pressure, odometry, fix,
)  # fmt: skip
ADAPTERS: dict[str, Adapter] = {a.msgtype: a for family in _FAMILIES for a in family.ADAPTERS}
"""Adapters by type, as ROS 2 (and `rosbags`, of ROS 1 too) names it: ``sensor_msgs/msg/Imu``."""


def adapter_of(msgtype: str) -> Adapter | None:
    """Adapter of a type, also by its ROS 1 name (``sensor_msgs/Imu``); None: there is none."""
    if msgtype.count("/") == 1:
        msgtype = msgtype.replace("/", "/msg/")
    return ADAPTERS.get(msgtype)
