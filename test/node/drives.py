"""A vehicle for tests of nodes: it drives along a room and says what its sensors see."""

import math

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.ros.convert.core_types import stamp_to_msg
from uw_dslam_ros2.ros.nodes.sonar_mapper import SonarMapper
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, STATIC_TF, SUBMAPS

__all__ = ["SPEED_M_S", "START_NS", "Vehicle", "drive", "finish", "mapper_of"]

START_NS = 1_000_000_000_000
SPEED_M_S = 0.5
HALF_WIDTH_M, HALF_HEIGHT_M = 6.0, 4.0


def scan_of_room(x_m):
    """Ranges of a room 12 m x 8 m from a point on its long axis, looking along it."""
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    with np.errstate(divide="ignore"):
        to_ends = np.where(np.cos(angles) > 0, HALF_WIDTH_M - x_m, HALF_WIDTH_M + x_m) / np.abs(
            np.cos(angles)
        )
        to_sides = HALF_HEIGHT_M / np.abs(np.sin(angles))
    return angles, np.minimum(to_ends, to_sides)


class Vehicle:
    """Sends what the sensors of a vehicle say that drives along the room, and hears the mapper."""

    def __init__(self, context, vehicle_id="auv_1", names=None):
        names = names or {"scan": "scan", "imu": "imu", "dvl": "dvl"}
        self.id = vehicle_id
        self.node = node = rclpy.create_node("vehicle", context=context, namespace=vehicle_id)
        self.scan_pub = node.create_publisher(LaserScan, names["scan"], 100)
        self.imu_pub = node.create_publisher(Imu, names["imu"], 100)
        self.twist_pub = node.create_publisher(TwistWithCovarianceStamped, names["dvl"], 100)
        self.static_pub = node.create_publisher(TFMessage, "/tf_static", STATIC_TF)
        self.submaps, self.maps, self.odometry, self.paths = [], [], [], []
        self.frames, self.diagnostics = {}, []
        node.create_subscription(SubmapMsg, "submap", self.submaps.append, SUBMAPS)
        node.create_subscription(OccupancyGrid, "map", self.maps.append, LATCHED)
        node.create_subscription(Path, "path", self.paths.append, LATCHED)
        node.create_subscription(Odometry, "odom", self.odometry.append, 100)
        node.create_subscription(TFMessage, "/tf", self._on_tf, 100)
        node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)
        self.finish_client = node.create_client(Trigger, "sonar_mapper/finish")

    def _on_tf(self, msg):
        for transform in msg.transforms:
            self.frames[transform.header.frame_id, transform.child_frame_id] = transform

    def is_connected(self):
        publishers = (self.scan_pub, self.imu_pub, self.twist_pub, self.static_pub)
        return all(publisher.get_subscription_count() for publisher in publishers)

    def send_mount(self, x_m=0.0):
        mount = TransformStamped(child_frame_id=f"{self.id}/sonar")
        mount.header.frame_id = f"{self.id}/base_link"
        mount.transform.translation.x = x_m
        self.static_pub.publish(TFMessage(transforms=[mount]))

    def scan_msg(self, stamp_ns, x_m):
        angles, ranges = scan_of_room(x_m)
        msg = LaserScan(
            angle_min=float(angles[0]),
            angle_increment=float(angles[1] - angles[0]),
            range_max=20.0,
            ranges=[float(value) for value in ranges],
        )
        msg.header.frame_id = f"{self.id}/sonar"
        msg.header.stamp = stamp_to_msg(stamp_ns)
        return msg

    def send_yaw(self, stamp_ns):
        imu = Imu()
        imu.header.stamp = stamp_to_msg(stamp_ns)
        imu.orientation_covariance[8] = 1e-4
        self.imu_pub.publish(imu)

    def send_second(self, second):
        """Messages of one second: ten of navigation, two scans."""
        for tenth in range(10):
            stamp_ns = START_NS + second * 1_000_000_000 + tenth * 100_000_000
            self.send_yaw(stamp_ns)
            twist = TwistWithCovarianceStamped()
            twist.header.stamp = stamp_to_msg(stamp_ns)
            twist.twist.twist.linear.x = SPEED_M_S
            twist.twist.covariance[0] = twist.twist.covariance[7] = 1e-4
            self.twist_pub.publish(twist)
            if tenth % 5 == 0:
                x_m = SPEED_M_S * (stamp_ns - START_NS) * 1e-9 - 3.0
                self.scan_pub.publish(self.scan_msg(stamp_ns, x_m))

    def values(self):
        statuses = [s for msg in self.diagnostics[-1:] for s in msg.status]
        return {value.key: value.value for status in statuses for value in status.values}

    def message(self):
        statuses = [status for msg in self.diagnostics[-1:] for status in msg.status]
        return statuses[-1].message if statuses else ""


def mapper_of(context, namespace="auv_1", **settings):
    settings = {
        "input": "scan",
        "velocity": "twist",
        "reorder_s": 10.0,
        "is_reliable": True,
        "mapper.occupancy.resolution_m": 0.1,
        **settings,
    }
    parameters = [Parameter(name, value=value) for name, value in settings.items()]
    return SonarMapper(context=context, namespace=namespace, parameter_overrides=parameters)


def finish(until, vehicle, num_frames=1):
    until(lambda: vehicle.values().get("num_frames") == str(num_frames), "the mount")
    until(vehicle.finish_client.service_is_ready, "the service")
    future = vehicle.finish_client.call_async(Trigger.Request())
    until(future.done, "the end of the mapping")
    return future.result()


def drive(until, vehicle, seconds):
    """Send, but no faster than the queues are emptied."""
    for second in seconds:
        count = int(vehicle.values().get("num_scan", "0"))
        vehicle.send_second(second)
        until(lambda c=count: int(vehicle.values().get("num_scan", "0")) >= c, "scans")
