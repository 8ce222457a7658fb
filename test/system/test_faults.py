"""Processes that die: servers in mid-request, and the manager, with real processes and signals."""

import os
import signal
import time

import pytest

pytest.importorskip("rclpy")

import rclpy
from places import room_submap
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.cli.running.processes import Children
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.sessions.session import load_session
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]

PATIENCE_S = 90.0
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MANY = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
T_ROOM = {
    "auv_1": SE2(2.0, 3.0, 0.0),
    "auv_2": SE2(5.0, 4.0, 2.0),
    "auv_3": SE2(7.0, 5.0, -1.0),
}


class Mission:
    """Sends submaps, hears the manager, and starts and kills processes."""

    def __init__(self, domain_id, children):
        self.children = children
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node("mission", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.status = None
        self.node.create_subscription(MergeStatus, "/merge_status", self._on_status, LATCHED)
        self._publishers = []

    def _on_status(self, msg):
        self.status = msg

    def until(self, is_true, what):
        end_s = time.monotonic() + PATIENCE_S
        while self.status is None or not is_true(self.status):
            assert time.monotonic() < end_s, f"not within {PATIENCE_S} s: {what}: {self.status}"
            self._executor.spin_once(timeout_sec=0.1)

    def send(self, vehicle):
        publisher = self.node.create_publisher(SubmapMsg, f"/{vehicle}/submap", MANY)
        publisher.publish(submap_to_msg(room_submap(vehicle, T_room_submap=T_ROOM[vehicle])))
        self._publishers.append(publisher)  # latched: a manager that comes back gets it again

    def start(self, name, node, *parameters):
        arguments = ["--ros-args", "-r", f"__node:={name}"]
        for parameter in parameters:
            arguments += ["-p", parameter]
        return self.children.start(
            name, f"uw_dslam_ros2.ros.nodes.{node}", arguments, may_end=True
        )

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def mission(ros_domain_id, tmp_path):
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "ros_logs"),
    }
    with Children(environment, tmp_path / "logs") as children:
        made = Mission(ros_domain_id, children)
        yield made
        made.close()


def send_signal(child, number):
    os.kill(child._process.pid, number)


def test_nothing_accepted_is_lost_when_servers_and_manager_are_killed(mission, tmp_path):
    session = str(tmp_path / "session")
    settings = (f"session:={session}", "publish_period_s:=0.1")
    manager = mission.start("map_queue_manager", "map_queue_manager", *settings)
    first = mission.start("first", "registration_server")
    mission.until(lambda s: s.num_servers == 1, "the first server")

    # Stopped, it takes the question and cannot answer; then it dies with it.
    send_signal(first, signal.SIGSTOP)
    mission.send("auv_1")
    mission.send("auv_2")
    mission.until(lambda s: s.num_in_flight == 1, "the question")
    send_signal(first, signal.SIGKILL)
    second = mission.start("second", "registration_server")
    mission.until(lambda s: s.num_merged == 2, "the merge by the server that came late")
    accepted = mission.status.num_registrations
    assert accepted >= 1

    send_signal(second, signal.SIGKILL)
    send_signal(manager, signal.SIGKILL)
    manager._process.wait(10)
    assert load_session(session).num_registrations == accepted
    mission.status = None
    mission.start("map_queue_manager", "map_queue_manager", *settings)
    mission.until(lambda s: len(s.submaps) == 2, "the session")
    assert mission.status.num_merged == 2, "merged without any server: the answer was kept"
    assert mission.status.num_registrations == accepted

    mission.start("third", "registration_server")
    mission.send("auv_3")
    mission.until(lambda s: s.num_merged == 3, "the third vehicle")
    merged = {(info.vehicle_id, info.sequence) for info in mission.status.submaps}
    assert merged == {(vehicle, 0) for vehicle in T_ROOM}
    assert len(mission.status.submaps) == 3
