"""An acoustic link in a process of its own, which is killed in the middle of a mission."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from std_msgs.msg import Empty, UInt8MultiArray
from unit.link.test_link import own_submap
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.link import AcousticLink, Layer, LinkConfig
from uw_dslam_ros2.core.link.coding.items import read_note
from uw_dslam_ros2.core.link.transport.packets import Packet, read_framed, unbundled
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg, submap_to_msg
from uw_dslam_ros2.ros.plumbing.qos import MODEM, SUBMAPS

pytestmark = pytest.mark.ros

TIME_SCALE = 20.0
NUM_SUBMAPS = 5
NODE = "from uw_dslam_ros2.ros.nodes.acoustic_link import main; raise SystemExit(main())"


@pytest.fixture
def start_link(ros_domain_id, tmp_path):
    """``start_link()`` starts the link of auv_2; what it received is kept from start to start."""
    running = []

    def start():
        settings = {"link.number": 2, "time_scale": TIME_SCALE, "state": tmp_path / "auv_2.link"}
        arguments = [text for pair in settings.items() for text in ("-p", "{}:={}".format(*pair))]
        process = subprocess.Popen(
            [sys.executable, "-c", NODE, "--ros-args", "-r", "__ns:=/auv_2", *arguments],
            env=os.environ | {"ROS_DOMAIN_ID": str(ros_domain_id), "ROS_LOG_DIR": str(tmp_path)},
        )
        running.append(process)
        return process

    yield start
    for process in running:
        process.kill()
        process.wait()


class Bridge:
    """The water between auv_1, which lives here, and auv_2's process; it loses nothing."""

    def __init__(self, context):
        self.until, self.other = None, AcousticLink(LinkConfig(number=1), "auv_1")
        self.node = rclpy.create_node("bridge", context=context)
        self.sent, self.given = [], {}
        self._ready = self.node.create_publisher(Empty, "/auv_2/modem/ready", MODEM)
        self._heard = self.node.create_publisher(UInt8MultiArray, "/auv_2/modem/received", MODEM)
        self.submaps = self.node.create_publisher(SubmapMsg, "/auv_2/submap", SUBMAPS)
        subscribe = self.node.create_subscription
        subscribe(
            UInt8MultiArray, "/auv_2/modem/send", lambda m: self.sent.append(bytes(m.data)), MODEM
        )
        for vehicle in ("auv_1", "auv_2"):
            subscribe(SubmapMsg, f"/auv_2/link/{vehicle}/submap", self._take, SUBMAPS)

    def _take(self, msg):
        submap = submap_from_msg(msg)
        self.given[submap.submap_id] = submap

    def wait_for_link(self):
        outputs = self._ready, self._heard, self.submaps
        self.until(lambda: all(o.get_subscription_count() == 1 for o in outputs), "its topics")
        self.until(lambda: self.node.count_publishers("/auv_2/modem/send") == 1)

    def turn(self, is_silent=False):
        """One packet each way, where there is something to say."""
        now_s = TIME_SCALE * time.monotonic()
        packet = None if is_silent else self.other.next_packet(now_s)
        if packet is not None:
            self._heard.publish(UInt8MultiArray(data=packet))
        before, end_s = len(self.sent), time.monotonic() + 0.5
        self._ready.publish(Empty())
        self.until(lambda: len(self.sent) > before or time.monotonic() > end_s)
        for data in self.sent[before:]:
            self.other.receive(data, now_s)

    def num_known(self, vehicle, layer=Layer.COARSE):
        """Submaps of a vehicle that its process gives out, with that layer."""
        found = [s for i, s in self.given.items() if i.vehicle_id == vehicle]
        return sum(submap.revision % 4 >= layer for submap in found)

    def has_told_all(self, num):
        """Whether so many of auv_2's submaps have come, whole."""
        found = [s for s in self.other.submaps() if s.vehicle_id == "auv_2"]
        return sum(submap.revision % 4 == Layer.FINE for submap in found) == num


def named(packets):
    """What each packet with content carries: number of an item, and which fragment of it."""
    found = []
    for packet in (Packet.unpack(data, b"") for data in packets):
        if packet.num_needed:
            found.append((packet.number, packet.index))
            continue
        for note in map(read_note, unbundled(packet.payload)):
            if isinstance(note, bytes):
                found.append((read_framed(note)[0], 0))
    return found


def test_a_killed_link_goes_on_and_says_nothing_twice(ros_context, spinning, start_link):
    process = start_link()
    bridge = Bridge(ros_context)
    with spinning(bridge.node) as bridge.until:
        bridge.wait_for_link()
        for sequence in range(NUM_SUBMAPS):
            bridge.other.add_submap(own_submap(1, sequence))
            bridge.submaps.publish(submap_to_msg(own_submap(2, sequence)))
        while bridge.num_known("auv_1") < 2:
            bridge.turn()
        process.send_signal(signal.SIGKILL)
        process.wait()
        before, told = dict(bridge.given), named(bridge.sent)
        assert bridge.num_known("auv_1", Layer.FINE) < NUM_SUBMAPS, "it was in the middle of it"
        bridge.given.clear()
        start_link()
        bridge.until(lambda: bridge.given.keys() >= before.keys(), "all that it had")
        for submap_id, submap in before.items():
            again = bridge.given[submap_id]
            assert again.revision == submap.revision
            np.testing.assert_array_equal(again.grid.values, submap.grid.values)
        bridge.wait_for_link()
        # Nobody has told it anything since: there is no reason to repeat.
        begin = len(bridge.sent)
        for _ in range(4):
            bridge.turn(is_silent=True)
        assert not set(named(bridge.sent[begin:])) & set(told)
        while bridge.num_known("auv_1", Layer.FINE) < NUM_SUBMAPS or not bridge.has_told_all(
            NUM_SUBMAPS
        ):
            bridge.turn()
