"""Parts of ROS messages as plain core values; `drivers` reads the messages of instruments.

Every function takes any object with the fields of the message: one of rclpy's, or one that
`rosbags` made.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.drivers.adapter import stamp_of
from uw_dslam_ros2.io.drivers.odometry import planar_pose

__all__ = ["matrix_of_transform", "pose_of_odometry", "stamp_of"]

FloatArray = NDArray[np.float64]


def matrix_of_transform(transform: Any) -> FloatArray:
    """``T_parent_child`` (4, 4) of a ``geometry_msgs/Transform``."""
    t, q = transform.translation, transform.rotation
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of_quaternion((q.x, q.y, q.z, q.w))
    matrix[:3, 3] = (t.x, t.y, t.z)
    if not np.isfinite(matrix).all():
        raise InvalidInputError(
            f"translation is {matrix[:3, 3].tolist()}, expected finite numbers"
        )
    return matrix


def pose_of_odometry(msg: Any) -> SE2:
    """Horizontal pose of a ``nav_msgs/Odometry`` in its header's frame."""
    return planar_pose(msg.pose.pose)
