"""The view beside a real manager: what the page is told is what the manager has."""

import json
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor

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


def test_two_views_show_what_either_of_them_decides(ros_context, spinning):
    fast = [Parameter("publish_period_s", value=0.1)]
    manager = MapQueueManager(context=ros_context, parameter_overrides=fast)
    free = [Parameter("port", value=0)]
    views = [View(context=ros_context, parameter_overrides=free) for _ in range(2)]
    probe = rclpy.create_node("probe", context=ros_context)

    def asked(view, path):
        with urllib.request.urlopen(view.url + path, timeout=20) as response:
            return json.load(response)

    def post(view, **fields):
        headers = {"Content-Type": "application/json", "Origin": view.url.rstrip("/")}
        body = json.dumps({"who": "Ann", **fields}).encode()
        request = urllib.request.Request(view.url + "api/decide", body, headers)
        try:
            with urllib.request.urlopen(request, timeout=20) as response:
                return json.load(response)
        except urllib.error.HTTPError as error:
            with error:
                return json.load(error)

    with (
        spinning(manager, *views, probe, RegistrationServer(context=ros_context)) as until,
        ThreadPoolExecutor(1) as pool,
    ):

        def decide(view, **fields):
            # The services answer while this thread spins.
            future = pool.submit(post, view, **fields)
            until(future.done, "an answer")
            return future.result()

        def until_states(*expected):
            for view in views:
                until(
                    lambda view=view: (
                        [s["state"] for s in asked(view, "api/scene")["submaps"]] == [*expected]
                    ),
                    f"{expected} on both pages",
                )

        publishers = []
        for name in T_ROOM:
            publishers.append(probe.create_publisher(SubmapMsg, f"/{name}/submap", SUBMAPS))
            publishers[-1].publish(submap_to_msg(room_submap(name, T_room_submap=T_ROOM[name])))
        until_states("merged", "merged")
        pair = {"source": ["auv_2", 0, 0], "target": ["auv_1", 0, 0]}
        assert decide(views[0], kind="forbid", **pair) == {"number": 1}
        until_states("merged", "waiting")
        fix = {"place": [5e5, 5e6, 0.5], "sigma_m": 1.0, "sigma_rad": 0.1}
        decide(views[1], kind="fix", source=["auv_1", 0, 0], earth_frame="EPSG:32632", **fix)
        until(lambda: asked(views[0], "api/scene")["earth"], "the other one's fix")
        assert decide(views[1], kind="undo", undone=1) == {"number": 3}
        until_states("merged", "merged")
        rows = asked(views[0], "api/scene")["decisions"]
        refused = decide(views[0], kind="pin", source=["auv_9", 0, 0])
        for view in views:
            view.stop()
    assert [(r["kind"], r["who"], r["is_in_force"]) for r in rows] == [
        ("forbid", "Ann", False),
        ("fix", "Ann", True),
        ("undo", "Ann", True),
    ]
    assert all(row["stamp_s"] > 0.0 for row in rows)
    assert "no submap auv_9/0" in refused["error"]


def test_a_manager_that_is_not_there_is_told(ros_context, spinning):
    settings = [Parameter("port", value=0), Parameter("manager", value="/north/manager")]
    view = View(context=ros_context, parameter_overrides=settings)
    with spinning(view):
        with urllib.request.urlopen(view.url + "api/status", timeout=20) as response:
            status = json.load(response)
        view.stop()
    assert status["notes"] == ["/north/manager is not heard"]
