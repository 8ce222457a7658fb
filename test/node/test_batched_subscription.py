"""A batched subscription hands over every message, in order, few wake-ups a burst."""

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32

from uw_dslam_ros2.ros.plumbing.batched_subscription import subscribe_batched

pytestmark = pytest.mark.ros

BURST = 100
QOS = QoSProfile(depth=2 * BURST)


@pytest.mark.parametrize("max_at_once", [1, 7, 1000])
def test_burst_arrives_whole_and_in_order(ros_context, max_at_once, spinning):
    sender = rclpy.create_node("sender", context=ros_context)
    reader = rclpy.create_node("reader", context=ros_context)
    heard = []
    subscribe_batched(
        reader, Int32, "numbers", heard.append, QOS, MutuallyExclusiveCallbackGroup(), max_at_once
    )
    publisher = sender.create_publisher(Int32, "numbers", QOS)
    with spinning(sender, reader) as until:
        until(publisher.get_subscription_count, "connection")
        for number in range(BURST):
            publisher.publish(Int32(data=number))
        until(lambda: len(heard) >= BURST, "the burst")
    assert [msg.data for msg in heard] == list(range(BURST))


def test_waiting_messages_cost_one_wake_up_up_to_the_limit(ros_context, spinning):
    sender = rclpy.create_node("sender", context=ros_context)
    reader = rclpy.create_node("reader", context=ros_context)
    heard = []
    subscription = subscribe_batched(
        reader, Int32, "numbers", heard.append, QOS, MutuallyExclusiveCallbackGroup(), 30
    )
    publisher = sender.create_publisher(Int32, "numbers", QOS)
    with spinning(sender) as until:
        until(publisher.get_subscription_count, "connection")
        for number in range(BURST):
            publisher.publish(Int32(data=number))
        assert publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=10))
        executor = SingleThreadedExecutor(context=ros_context)
        executor.add_node(reader)
        lengths = [0]
        while lengths[-1] < BURST:
            executor.spin_once(timeout_sec=10.0)
            if len(heard) > lengths[-1]:
                lengths.append(len(heard))
        executor.remove_node(reader)
    reader.destroy_subscription(subscription)
    reader.destroy_node()
    assert lengths == [0, 30, 60, 90, 100]
