"""What a view costs the nodes that it shows: what it asks of them, and what it leaves behind."""

import contextlib
import dataclasses
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from collections import Counter

import pytest

pytest.importorskip("rclpy")

import rclpy
from node.test_map_queue_manager import FAST, manage, two_submaps  # noqa: F401
from places import room_submap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.srv import GetSubmap, ListDecisions, ListRegistrations

from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.convert.merging import record_to_msg
from uw_dslam_ros2.ros.nodes.view import View
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SERVICES

pytestmark = pytest.mark.ros

NUM_STATES = 4


class Manager:
    """A stand-in that counts what it is asked."""

    def __init__(self, context):
        self.node = rclpy.create_node("map_queue_manager", context=context)
        self.asked = Counter()
        self.submap = room_submap("auv_1")
        self._status = self.node.create_publisher(MergeStatus, "/merge_status", LATCHED)
        for service_type, name, answer in (
            (GetSubmap, "get_submap", self._give),
            (ListRegistrations, "list_registrations", lambda response: response),
            (ListDecisions, "list_decisions", lambda response: response),
        ):
            self._serve(service_type, name, answer)

    def _serve(self, service_type, name, answer):
        def serve(_request, response):
            self.asked[name] += 1
            return answer(response)

        self.node.create_service(
            service_type, f"~/{name}", serve, qos_profile=SERVICES,
            callback_group=ReentrantCallbackGroup(),
        )  # fmt: skip

    def _give(self, response):
        response.result = response.DONE
        response.submap = submap_to_msg(self.submap)
        return response

    def change(self, revision):
        """The submap grows, and a registration is answered."""
        self.submap = dataclasses.replace(self.submap, revision=revision)
        self.tell()

    def tell(self):
        """What a manager says after a change, and once a second."""
        T_map_submap = SE2(float(self.submap.revision))
        record = SubmapRecord(self.submap, SubmapState.MERGED, 0, T_map_submap, 0, "")
        self._status.publish(
            MergeStatus(
                submaps=[record_to_msg(record)], num_registrations=self.submap.revision + 1
            )
        )


def pages(url, count):
    """As many browsers that follow what changes: each asks for the scene when it is told."""
    connections, asked = [], Counter()

    def follow(number):
        with (
            contextlib.suppress(OSError, ValueError),
            urllib.request.urlopen(f"{url}api/events", timeout=20) as events,
        ):
            for line in events:
                if line.startswith(b"data"):
                    urllib.request.urlopen(f"{url}api/scene", timeout=20).close()
                    asked[number] += 1

    for number in range(count):
        connections.append(threading.Thread(target=follow, args=(number,), daemon=True))
        connections[-1].start()
    return asked, connections


def test_what_a_view_asks_follows_what_is_new_however_many_look(ros_context, spinning):
    free = [Parameter("port", value=0)]
    manager, view = Manager(ros_context), View(context=ros_context, parameter_overrides=free)
    counts = []
    with spinning(manager.node, view) as until:
        revision = 0
        for num_pages in (0, 3):
            asked, browsers = pages(view.url, num_pages)
            before = manager.asked.copy()
            for _ in range(NUM_STATES):
                revision += 1
                manager.change(revision)
                until(
                    lambda expected=revision: (
                        [r.T_component_submap.x for r in view.showing().records] == [expected]
                    ),
                    "the new revision on the page",
                )
                for _ in range(5):  # nothing happens, and is told
                    manager.tell()
            until(lambda: len(asked) == num_pages, "all pages have asked")  # noqa: B023
            counts.append(manager.asked - before)
        view.stop()
        for browser in browsers:
            browser.join(20)
    assert counts[0] == counts[1]
    assert counts[0] == dict.fromkeys(
        ("get_submap", "list_registrations", "list_decisions"), NUM_STATES
    )


def test_a_view_that_is_killed_leaves_a_manager_that_goes_on(
    manage,  # noqa: F811
    ros_domain_id,
):
    environment = os.environ | {"ROS_DOMAIN_ID": str(ros_domain_id)}
    command = [sys.executable, "-m", "uw_dslam_ros2.ros.nodes.view", "--ros-args", "-p", "port:=0"]
    with manage(has_server=False, **FAST) as (until, probe, call):
        view = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        lines = []
        reader = threading.Thread(target=lambda: lines.extend(view.stdout), daemon=True)
        reader.start()
        try:
            first, second = two_submaps()
            probe.send(first)
            until(lambda: any("open http" in line for line in lines), "the page's address")
            url = re.search(r"http://\S+", next(line for line in lines if "open http" in line))[0]

            def is_shown():
                with urllib.request.urlopen(f"{url}api/scene", timeout=20) as response:
                    return b"auv_1/0" in response.read()

            until(is_shown, "the submap on the page")
        finally:
            view.send_signal(signal.SIGKILL)
            view.wait(10)
            reader.join(10)
            view.stdout.close()
        probe.send(second)
        until(lambda: len(probe.states()) == 2, "the next submap")
        assert call(ListDecisions, "list_decisions").decisions == []
