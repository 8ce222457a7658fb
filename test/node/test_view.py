"""The view beside a real manager: what the page is told is what the manager has."""

import json
import urllib.request

import pytest

pytest.importorskip("rclpy")

import rclpy
from places import room_submap
from rclpy.parameter import Parameter
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.nodes.view import View
from uw_dslam_ros2.ros.plumbing.qos import SUBMAPS

pytestmark = pytest.mark.ros

T_ROOM = {"auv_1": SE2(2.0, 3.0, 0.0), "auv_2": SE2(5.0, 4.0, 2.0)}


def test_the_page_follows_the_merge(ros_context, spinning):
    fast = [Parameter("publish_period_s", value=0.1)]
    manager = MapQueueManager(context=ros_context, parameter_overrides=fast)
    view = View(context=ros_context, parameter_overrides=[Parameter("port", value=0)])
    probe = rclpy.create_node("probe", context=ros_context)

    def asked(path):
        with urllib.request.urlopen(view.url + path, timeout=20) as response:
            return json.load(response)

    with spinning(manager, view, probe, RegistrationServer(context=ros_context)) as until:
        assert asked("api/scene")["submaps"] == []
        publishers = {}
        for name in T_ROOM:
            publishers[name] = probe.create_publisher(SubmapMsg, f"/{name}/submap", SUBMAPS)
            submap = room_submap(name, T_room_submap=T_ROOM[name])
            publishers[name].publish(submap_to_msg(submap))
        until(
            lambda: [s["state"] for s in asked("api/scene")["submaps"]] == ["merged", "merged"],
            "both vehicles on the page",
        )
        until(lambda: asked("api/scene")["registrations"], "the registration on the page")
        scene = asked("api/scene")
        status = asked("api/status")
        pair = asked("api/pairs/1")
        view.stop()
    assert [vehicle["name"] for vehicle in scene["vehicles"]] == ["auv_1", "auv_2"]
    assert len(scene["groups"]) == 1
    (edge,) = [c for c in scene["constraints"] if c["kind"] == "registration"]
    assert edge["is_inlier"]
    assert any(row["is_used"] for row in scene["registrations"])
    assert all(row["verdict"] == "ACCEPTED" for row in scene["registrations"] if row["is_used"])
    assert pair["rows"] > 50
    assert set(status["ages"]) == {"auv_1", "auv_2"}
    assert not any("is not heard" in note for note in status["notes"])


def test_a_manager_that_is_not_there_is_told(ros_context, spinning):
    settings = [Parameter("port", value=0), Parameter("manager", value="/north/manager")]
    view = View(context=ros_context, parameter_overrides=settings)
    with spinning(view):
        with urllib.request.urlopen(view.url + "api/status", timeout=20) as response:
            status = json.load(response)
        view.stop()
    assert status["notes"] == ["/north/manager is not heard"]
