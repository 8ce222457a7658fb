"""What a mapper tells: submaps, its own map and path, odometry and frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.pose_graph import compose_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_to_msg,
    odometry_to_msg,
    path_to_msg,
    stamp_to_msg,
    submap_to_msg,
)
from uw_dslam_ros2.ros.plumbing.frames import FrameBroadcaster, transform_to_msg
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, LATCHED, SUBMAPS

__all__ = ["MapperOutputs"]

_PATH_MAX_POSES = 2000  # a longer path is thinned when published


class MapperOutputs:
    """Publishes ``submap``, ``map``, ``path``, ``odom`` and, unless told not to, ``/tf``.

    Parameters
    ----------
    base_frame
        The vehicle's body.
    """

    TOPICS = ("submap", "map", "path", "odom")

    def __init__(
        self, node: Node, config: SonarMapperConfig, vehicle_id: str, base_frame: str
    ) -> None:
        self._base_frame = base_frame
        self._map_frame = config.map_frame or f"{vehicle_id}/map"
        self._odom_frame = config.odom_frame or f"{vehicle_id}/odom"
        self._submap_pub = node.create_publisher(SubmapMsg, "submap", SUBMAPS)
        self._map_pub = node.create_publisher(OccupancyGrid, "map", LATCHED)
        self._path_pub = node.create_publisher(Path, "path", LATCHED)
        self._odom_pub = node.create_publisher(Odometry, "odom", DEFAULT)
        self._broadcaster = FrameBroadcaster(node) if config.publishes_tf else None
        self._sent: set[SubmapId] = set()
        self._T_odom_base = self._T_odom_run = self._T_map_odom = SE2()
        self._depth_z_m = 0.0
        self._smooth_mapper: VehicleMapper | None = None
        self.counts: Counter[str] = Counter()
        """Messages sent, for the diagnostics."""

    def publish_submaps(self, submaps: Iterable[Submap], *, is_drawn_anew: bool = False) -> None:
        """Send submaps; of those that were sent before only the pose, unless drawn anew."""
        for submap in submaps:
            self.counts["num_submap_messages"] += 1
            # What is closed moves, and mostly changes no more: a grid is a megabyte.
            is_known = submap.submap_id in self._sent and not is_drawn_anew
            self.counts["num_pose_messages"] += is_known
            self._submap_pub.publish(submap_to_msg(submap, is_pose_only=is_known))
            self._sent.add(submap.submap_id)

    def wait_for_readers(self, timeout_s: float) -> None:
        """Wait until all submaps have reached those who listen, or the time is over."""
        self._submap_pub.wait_for_all_acked(Duration(seconds=timeout_s))

    def publish_odometry(self, mapper: VehicleMapper, stamp_ns: int) -> None:
        """Send where the vehicle is, without a jump also where a new run begins."""
        if self._smooth_mapper is not mapper:
            # A new run begins at its own zero; odometry goes on from where it was.
            self._T_odom_run = self._T_odom_base @ mapper.T_smooth_base.inverse()
            self._smooth_mapper = mapper
        self._T_odom_base = self._T_odom_run @ mapper.T_smooth_base
        msg = odometry_to_msg(
            self._T_odom_base,
            _turned(mapper.smooth_covariance, self._T_odom_run),
            *mapper.velocity,
            mapper.velocity_covariance,
            mapper.depth_m,
        )
        msg.header.stamp = stamp_to_msg(stamp_ns)
        msg.header.frame_id, msg.child_frame_id = self._odom_frame, self._base_frame
        self._odom_pub.publish(msg)
        self._depth_z_m = msg.pose.pose.position.z
        # Loop closures, and where a new run lies, move the frame and not the odometry.
        self._T_map_odom = mapper.T_odom_base @ self._T_odom_base.inverse()
        self._send_frames(stamp_ns)

    def correct_frames(
        self, before: NDArray[np.float64], after: NDArray[np.float64], stamp_ns: int
    ) -> None:
        """Send frames once more: the run's path in its map (K, 3) has moved since the last."""
        if not len(before):
            return
        T_after_before = SE2.from_array(after[-1]) @ SE2.from_array(before[-1]).inverse()
        self._T_map_odom = T_after_before @ self._T_map_odom
        self._send_frames(stamp_ns)

    def _send_frames(self, stamp_ns: int) -> None:
        if self._broadcaster is None:
            return
        stamp = stamp_to_msg(stamp_ns)
        T_odom_base = transform_to_msg(
            stamp, self._odom_frame, self._base_frame, self._T_odom_base
        )
        T_odom_base.transform.translation.z = self._depth_z_m
        self._broadcaster.send(
            transform_to_msg(stamp, self._map_frame, self._odom_frame, self._T_map_odom),
            T_odom_base,
        )

    def publish_map(self, mapper: VehicleMapper, stamp_ns: int) -> None:
        """Send the run's map and path, if it has any."""
        stamps_ns, poses = mapper.trajectory()
        if not len(poses):
            return
        occupancy = mapper.vehicle_map()
        self._map_pub.publish(occupancy_to_msg(occupancy, self._map_frame, stamp_ns))
        path = path_to_msg(stamps_ns, poses, self._map_frame, stamp_ns, _PATH_MAX_POSES)
        self._path_pub.publish(path)


def _turned(covariance: NDArray[np.float64], T_odom_run: SE2) -> NDArray[np.float64]:
    """The covariance (3, 3) of a pose in the run's own frame, in odom."""
    return compose_covariance(covariance, T_odom_run, SE2(), SE2())
