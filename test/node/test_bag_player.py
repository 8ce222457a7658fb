"""Playing bags into the graph: order, clock, pause, waiting, refusals."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import FluidPressure
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.recordings import BagWriter
from uw_dslam_ros2.ros.convert.core_types import stamp_ns_from_msg
from uw_dslam_ros2.ros.nodes.bag_player import BagPlayer
from uw_dslam_ros2.ros.plumbing.qos import STATIC_TF

pytestmark = pytest.mark.ros

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
NUM_MESSAGES = 100  # two seconds
FLIPPED = (1.0, 0.0, 0.0, 0.0)


def write_bag(path, vehicle_id, start_ns=START_NS):
    with BagWriter(path) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
        writer.add_topic(f"/{vehicle_id}/depth", "sensor_msgs/msg/FluidPressure")
        mounts = [(f"{vehicle_id}/depth", (0.0, 0.0, 0.0), FLIPPED)]
        transforms = make.transforms(start_ns, f"{vehicle_id}/base_link", mounts)
        writer.write("/tf_static", start_ns, transforms)
        for i in range(NUM_MESSAGES):
            stamp_ns = start_ns + i * STEP_NS
            message = make.pressure(stamp_ns, f"{vehicle_id}/depth", float(i), 0.01)
            writer.write(f"/{vehicle_id}/depth", stamp_ns, message)
    return str(path)


@pytest.fixture
def bags(tmp_path):
    return [
        write_bag(tmp_path / "auv_1", "auv_1"),
        write_bag(tmp_path / "auv_2", "auv_2", START_NS + STEP_NS // 2),
    ]


class Listener:
    def __init__(self, context):
        self.node = rclpy.create_node("listener", context=context)
        self.heard, self.clocks, self.static = [], [], []
        for vehicle_id in ("auv_1", "auv_2"):
            self.node.create_subscription(
                FluidPressure, f"/{vehicle_id}/depth", self._on_depth, 1000
            )
        self.node.create_subscription(Clock, "/clock", self.clocks.append, 1000)
        self.node.create_subscription(TFMessage, "/tf_static", self.static.append, STATIC_TF)

    def _on_depth(self, msg):
        self.heard.append((msg.header.frame_id, stamp_ns_from_msg(msg.header.stamp)))

    def stamps_of(self, vehicle_id):
        return [stamp_ns for frame_id, stamp_ns in self.heard if frame_id.startswith(vehicle_id)]


def player_of(context, bags, **settings):
    settings = {"bags": bags, "rate": 10.0, **settings}
    parameters = [Parameter(name, value=value) for name, value in settings.items()]
    return BagPlayer(context=context, parameter_overrides=parameters)


def test_every_message_arrives_with_clock_and_mounts(ros_context, spinning, bags):
    listener = Listener(ros_context)
    player = player_of(ros_context, bags)
    with spinning(player, listener.node) as until:
        until(player.finished.done, "the end")
        until(lambda: len(listener.heard) == 2 * NUM_MESSAGES, "all messages")
        until(lambda: len(listener.static) == 2, "mounts of both bags")
        last_ns = START_NS + STEP_NS // 2 + (NUM_MESSAGES - 1) * STEP_NS
        until(lambda: stamp_ns_from_msg(listener.clocks[-1].clock) == last_ns, "the last clock")
    assert player.finished.result() == 0
    for index, vehicle_id in enumerate(("auv_1", "auv_2")):
        first_ns = START_NS + index * STEP_NS // 2
        expected = [first_ns + i * STEP_NS for i in range(NUM_MESSAGES)]
        assert listener.stamps_of(vehicle_id) == expected
    clocks_ns = [stamp_ns_from_msg(msg.clock) for msg in listener.clocks]
    assert np.all(np.diff(clocks_ns) >= 0)
    assert clocks_ns[0] == START_NS


def test_start_and_duration_cut_the_recording_but_not_the_mounts(ros_context, spinning, bags):
    listener = Listener(ros_context)
    player = player_of(ros_context, bags[:1], start_s=0.5, duration_s=0.4)
    with spinning(player, listener.node) as until:
        until(player.finished.done, "the end")
        until(lambda: len(listener.heard) == 20, "the part")
        until(lambda: listener.static, "the mounts")
    assert listener.heard[0][1] == START_NS + 500_000_000
    assert listener.heard[-1][1] < START_NS + 900_000_000


def test_nothing_is_sent_before_somebody_reads(ros_context, spinning, bags):
    player = player_of(ros_context, bags[:1])
    probe = rclpy.create_node("probe", context=ros_context)
    heard = []
    with spinning(player, probe) as until:
        until(lambda: probe.count_publishers("/auv_1/depth") == 1, "the player")
        probe.create_subscription(FluidPressure, "/auv_1/depth", heard.append, 1000)
        until(player.finished.done, "the end")
        until(lambda: len(heard) == NUM_MESSAGES, "all messages")


def test_waiting_for_readers_ends(ros_context, spinning, bags):
    player = player_of(ros_context, bags[:1], wait_s=0.2)
    with spinning(player) as until:
        until(player.finished.done, "the end")
    assert player.finished.result() == 0


def test_pause_holds_the_clock(ros_context, spinning, bags):
    listener = Listener(ros_context)
    player = player_of(ros_context, bags[:1], is_paused=True, rate=2.0)
    client = listener.node.create_client(SetBool, "/bag_player/pause")

    with spinning(player, listener.node) as until:

        def pause(is_paused):
            future = client.call_async(SetBool.Request(data=is_paused))
            until(future.done, "the answer")
            assert future.result().success

        until(client.service_is_ready, "the service")
        until(lambda: listener.static, "the mounts")
        assert listener.heard == []
        pause(False)
        until(lambda: len(listener.heard) >= 5, "messages")
        pause(True)
        pause(True)  # by now the player's thread has seen the first one
        num_published = player.num_published
        for _ in range(3):
            pause(True)  # round trips, in which a running player would have sent
        assert player.num_published == num_published < NUM_MESSAGES
        until(lambda: len(listener.heard) == num_published, "what was sent before")
        pause(False)
        until(lambda: len(listener.heard) == NUM_MESSAGES, "the rest")


def test_loop_starts_again(ros_context, spinning, bags):
    listener = Listener(ros_context)
    player = player_of(ros_context, bags[:1], is_looping=True, duration_s=0.2)
    with spinning(player, listener.node) as until:
        until(lambda: len(listener.heard) >= 25, "the second round")
    stamps_ns = listener.stamps_of("auv_1")
    assert stamps_ns[10] == stamps_ns[0] == START_NS


def test_only_chosen_topics_are_played(ros_context, spinning, bags):
    listener = Listener(ros_context)
    player = player_of(ros_context, bags, topics=["/auv_2/depth"])
    with spinning(player, listener.node) as until:
        until(player.finished.done, "the end")
        until(lambda: len(listener.heard) == NUM_MESSAGES, "the messages")
    assert listener.stamps_of("auv_1") == []


@pytest.mark.parametrize("name", ["nowhere", "empty_folder"])
def test_unusable_bag_ends_with_code_1(ros_context, spinning, tmp_path, name):
    (tmp_path / "empty_folder").mkdir()
    player = player_of(ros_context, [str(tmp_path / name)])
    with spinning(player) as until:
        until(player.finished.done, "the end")
    assert player.finished.result() == 1


def test_no_bags_are_refused(ros_context):
    with pytest.raises(ConfigError, match="bags is empty, expected at least one path"):
        BagPlayer(context=ros_context)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"rate": 0.0}, "rate is 0.0, expected 0.01"),
        ({"speed": 2.0}, "speed is unknown to bag_player"),
    ],
)
def test_bad_setting_is_refused(ros_context, bags, settings, words):
    with pytest.raises(ConfigError, match=words):
        player_of(ros_context, bags, **settings)
