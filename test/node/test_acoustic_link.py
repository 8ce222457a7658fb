"""Vehicles whose managers get each other's submaps through modems and a simulated channel."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from places import room_submap
from rclpy.parameter import Parameter
from std_msgs.msg import Empty, UInt8MultiArray
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.link import Layer
from uw_dslam_ros2.core.link.transport.packets import Packet
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.sessions.link_state import load_link_state
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg, submap_to_msg
from uw_dslam_ros2.ros.nodes.acoustic_link import AcousticLinkNode
from uw_dslam_ros2.ros.nodes.channel import ChannelNode
from uw_dslam_ros2.ros.plumbing.qos import MODEM, SUBMAPS

pytestmark = pytest.mark.ros


def make(node_type, context, namespace=None, **settings):
    parameters = [Parameter(name.replace("__", "."), value=v) for name, v in settings.items()]
    names = {} if namespace is None else {"namespace": namespace}
    return node_type(context=context, parameter_overrides=parameters, **names)


def make_link(context, number, time_scale=2.0, **settings):
    return make(
        AcousticLinkNode,
        context,
        f"auv_{number}",
        link__number=number,
        time_scale=time_scale,
        **settings,
    )


@pytest.fixture
def fleet(ros_context, spinning):
    """``with fleet(loss=0.2) as (until, send, got)``: two vehicles and the water between them.

    `fleet.links` are their nodes then; the second one keeps its `state` in a file.
    """
    import contextlib

    @contextlib.contextmanager
    def run(state="", blackouts_s=None, time_scale=2.0, **channel):
        run.water = water = make(
            ChannelNode,
            ros_context,
            vehicles=["auv_1", "auv_2"],
            time_scale=time_scale,
            **({"blackouts_s": blackouts_s} if blackouts_s else {}),
            **{f"channel__{name}": value for name, value in channel.items()},
        )
        run.links = links = [
            make_link(ros_context, 1, time_scale),
            make_link(ros_context, 2, time_scale, state=state),
        ]
        probe = rclpy.create_node("probe", context=ros_context)
        outputs, got = {}, {1: {}, 2: {}}
        for number in (1, 2):
            topic = f"/auv_{number}/submap"
            outputs[number] = probe.create_publisher(SubmapMsg, topic, SUBMAPS)
            for other in (1, 2):

                def take(msg, number=number):
                    got[number][msg.vehicle_id, msg.sequence] = submap_from_msg(msg)

                topic = f"/auv_{number}/link/auv_{other}/submap"
                probe.create_subscription(SubmapMsg, topic, take, SUBMAPS)

        def send(submap):
            outputs[int(submap.vehicle_id[-1])].publish(submap_to_msg(submap))

        with spinning(water, *links, probe) as until:
            until(lambda: all(o.get_subscription_count() for o in outputs.values()), "links")
            yield until, send, got

    return run


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_each_vehicle_gets_the_others_submaps_and_its_own_as_they_have_it(fleet, loss):
    with fleet(loss=loss) as (until, send, got):
        for number in (1, 2):
            send(room_submap(f"auv_{number}", 0, T_odom_submap=SE2(1.0, number, 0.5)))
        until(lambda: all(len(known) == 2 for known in got.values()), "two submaps each")
        until(lambda: all(s.revision == Layer.FINE for k in got.values() for s in k.values()))
    for key in (("auv_1", 0), ("auv_2", 0)):
        mine, theirs = got[1][key], got[2][key]
        np.testing.assert_array_equal(mine.grid.values, theirs.grid.values)
        assert mine.T_odom_submap == theirs.T_odom_submap
        assert mine.grid.spec.resolution_m == pytest.approx(0.1)


def test_a_submap_that_is_drawn_anew_moves_and_is_not_sent_once_more(fleet):
    with fleet() as (until, send, got):
        send(room_submap("auv_1", 0))
        until(lambda: all(k and k["auv_1", 0].revision == Layer.FINE for k in got.values()))
        first = fleet.links[0]._link.own_submap(SubmapId("auv_1", 0, 0))
        send(
            room_submap(
                "auv_1",
                revision=1,
                T_room_submap=SE2(0.3, 0.0, 0.0),
                T_odom_submap=SE2(1.0, 0.5, 0.0),
            )
        )
        until(lambda: got[2]["auv_1", 0].T_odom_submap.x == pytest.approx(1.0, abs=0.01))
        again = fleet.links[0]._link.own_submap(SubmapId("auv_1", 0, 0))
    np.testing.assert_array_equal(again.grid.values, first.grid.values)


def test_nothing_arrives_in_a_blackout_and_all_of_it_afterwards(fleet):
    with fleet(blackouts_s=[0.0, 16.0], time_scale=8.0) as (until, send, got):
        send(room_submap("auv_1", 0))
        until(lambda: fleet.water._report()[2]["blacked out"] > 0, "a packet that is lost")
        assert not got[2]
        # Where all of it was sent in the blackout, a heartbeat is what gets it going again.
        until(lambda: got[2], "the submap", deadline_s=120.0)
        assert fleet.water._now_s() > 16.0


def test_a_link_goes_on_where_it_was_stopped(ros_context, spinning, tmp_path):
    state = str(tmp_path / "link.json")
    link = make_link(ros_context, 1, state=state)
    probe = rclpy.create_node("probe", context=ros_context)
    output = probe.create_publisher(SubmapMsg, "/auv_1/submap", SUBMAPS)
    got = []
    with spinning(link, probe) as until:
        probe.create_subscription(SubmapMsg, "/auv_1/link/auv_1/submap", got.append, SUBMAPS)
        output.publish(submap_to_msg(room_submap("auv_1", 4)))
        until(lambda: got)
    again, other = make_link(ros_context, 1, state=state), []
    probe = rclpy.create_node("probe", context=ros_context)
    probe.create_subscription(SubmapMsg, "/auv_1/link/auv_1/submap", other.append, SUBMAPS)
    with spinning(again, probe) as until:
        until(lambda: other)
    assert other[0] == got[0]


def test_a_modem_is_given_one_packet_each_time_that_it_is_ready(ros_context, spinning):
    """What a bridge to a real modem does; docs/link.md describes it."""
    link = make_link(ros_context, 1, link__packet_bytes=32)
    bridge = rclpy.create_node("bridge", context=ros_context)
    packets = []
    bridge.create_subscription(
        UInt8MultiArray, "/auv_1/modem/send", lambda m: packets.append(bytes(m.data)), MODEM
    )
    ready = bridge.create_publisher(Empty, "/auv_1/modem/ready", MODEM)
    with spinning(link, bridge) as until:
        until(
            lambda: ready.get_subscription_count() and bridge.count_publishers("/auv_1/modem/send")
        )
        ready.publish(Empty())
        until(lambda: packets)
    assert len(packets) == 1
    assert len(packets[0]) <= 32


def test_noise_from_a_modem_is_counted(ros_context, spinning):
    link = make_link(ros_context, 1)
    bridge = rclpy.create_node("bridge", context=ros_context)
    output = bridge.create_publisher(UInt8MultiArray, "/auv_1/modem/received", MODEM)
    with spinning(link, bridge) as until:
        until(lambda: output.get_subscription_count())
        output.publish(UInt8MultiArray(data=b"\x00" * 20))
        until(lambda: any(name.startswith("refused") for name in link._report()[2]))


def test_hostile_packets_make_no_submap_and_are_told(fleet, rng):
    """Sound checksums over anything, old packets again, and a liar who has no key."""
    with fleet() as (until, send, got):
        send(room_submap("auv_1", 0))
        until(lambda: got[2], "a submap")
        link = fleet.links[1]
        probe = rclpy.create_node("liar", context=link.context)
        output = probe.create_publisher(UInt8MultiArray, "/auv_2/modem/received", MODEM)
        until(output.get_subscription_count)
        for _ in range(20):  # not more than the queue holds
            fields = [int(rng.integers(0, n)) for n in (4, 32, 1024, 64, 128)]
            packet = Packet(*fields, rng.bytes(int(rng.integers(1, 58)))).pack(b"")
            for data in (packet, packet[:-1], packet, bytes([packet[0] ^ 0xC0]) + packet[1:]):
                output.publish(UInt8MultiArray(data=data))

        def num_refused():
            return sum(n for name, n in link._report()[2].items() if name.startswith("refused"))

        until(lambda: num_refused() >= 40, "all that is damaged")
        probe.destroy_node()
    assert set(got[2]) == {("auv_1", 0)}


def test_a_killed_link_has_all_that_it_received_and_asks_for_nothing_again(
    ros_context, spinning, fleet, tmp_path
):
    state = str(tmp_path / "link.json")
    with fleet(state=state) as (until, send, got):
        send(room_submap("auv_1", 0))
        until(lambda: got[2] and got[2]["auv_1", 0].revision == Layer.FINE, "the submap")
        before = fleet.links[1]._link.to_state()
        until(lambda: load_link_state(state).received == before.received, "it on the disk")
    again = make_link(ros_context, 2, state=state)
    with spinning(again):
        assert [s.submap_id for s in again._link.submaps()] == [("auv_1", 0, 0)]
        assert again._link.to_state().received == before.received
        assert again._link.is_complete


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({}, "vehicles has 0 names"),
        ({"vehicles": ["a", "b"], "domains": ["1"]}, "domains 1 numbers"),
        ({"vehicles": ["a"], "domains": ["x"]}, "domains holds 'x'"),
        ({"vehicles": ["a"], "preset": "fast"}, "expected one of nano, rate0, psk5"),
        ({"vehicles": ["a"], "blackouts_s": [5.0]}, "times that increase, an even number"),
        ({"vehicles": ["a"], "blackouts_s": [5.0, 2.0]}, "times that increase, an even number"),
    ],
)
def test_a_channel_without_sense_is_refused(ros_context, settings, text):
    with pytest.raises(ConfigError, match=text):
        make(ChannelNode, ros_context, **settings)
