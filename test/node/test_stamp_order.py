"""Messages leave in the order of their stamps, whatever order they come in."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.ros.plumbing.stamp_order import StampOrder

pytestmark = pytest.mark.ros

FOREVER = 10**12


def drained(order):
    items = []
    while (item := order.peek()) is not None:
        assert order.pop() == item
        items.append(item)
    return items


@pytest.mark.parametrize("seed", range(5))
def test_streams_in_order_become_one_stream_in_order(seed):
    """Three queues, each in order, emptied at random: as an executor does after a stall."""
    rng = np.random.default_rng(seed)
    queues = {"imu": 100, "dvl": 30, "sonar": 10}
    queues = {name: sorted(rng.choice(10_000, n, False).tolist()) for name, n in queues.items()}
    every_stamp = sorted(stamp for queue in queues.values() for stamp in queue)
    order = StampOrder(hold_ns=FOREVER, jump_ns=FOREVER)
    for name, queue in queues.items():
        order.advance(name, queue[0])  # all have been heard of
    got = []
    while any(queues.values()):
        name = rng.choice([name for name, queue in queues.items() if queue])
        stamp = queues[name].pop(0)
        order.add(name, stamp, stamp)
        got += drained(order)
        assert got == every_stamp[: len(got)]
    assert got + list(order.rest()) == every_stamp
    assert order.num_late == 0


def test_item_waits_for_the_slowest_stream():
    order = StampOrder(hold_ns=FOREVER, jump_ns=FOREVER)
    order.add("imu", 5, "imu 5")
    order.advance("dvl", 3)
    order.add("imu", 10, "imu 10")
    assert drained(order) == []
    order.add("dvl", 7, "dvl 7")
    assert drained(order) == ["imu 5", "dvl 7"]


def test_dead_stream_is_not_waited_for():
    order = StampOrder(hold_ns=100, jump_ns=FOREVER)
    order.advance("dvl", 10)
    order.add("imu", 100, "a")
    assert drained(order) == []
    order.add("imu", 111, "b")
    assert drained(order) == ["a", "b"]


@pytest.mark.parametrize("names", [("dvl", "imu", "sonar"), ("sonar", "imu", "dvl")])
def test_equal_stamps_leave_by_the_name_of_their_stream(names):
    order = StampOrder(hold_ns=0, jump_ns=FOREVER)
    for name in names:
        order.add(name, 5, name)
    order.add("dvl", 5, "dvl again")
    assert drained(order) == ["dvl", "dvl again", "imu", "sonar"]


def test_late_item_is_counted_and_leaves_at_once():
    order = StampOrder(hold_ns=0, jump_ns=FOREVER)
    order.add("imu", 200, "a")
    assert drained(order) == ["a"]
    order.add("dvl", 50, "late")
    assert order.num_late == 1
    assert drained(order) == ["late"]


def test_jump_back_is_judged_for_each_stream():
    order = StampOrder(hold_ns=10, jump_ns=100)
    order.add("imu", 1000, "a")
    assert not order.has_jumped_back("dvl", 10)
    assert not order.has_jumped_back("imu", 900)
    assert order.has_jumped_back("imu", 899)
    order.clear()
    assert not order.has_jumped_back("imu", 899)


def test_expected_stream_is_waited_for_from_the_start_on():
    order = StampOrder(hold_ns=100, jump_ns=50)
    order.expect("dvl", 1000)
    order.add("imu", 1000, "a")
    order.add("imu", 1099, "b")
    assert drained(order) == ["a"]
    assert not order.has_jumped_back("dvl", 900)  # its first, however early
    order.add("dvl", 1050, "c")
    assert drained(order) == ["c"]
    order.expect("imu", 5000)  # heard of already: nothing changes
    order.add("dvl", 1100, "d")
    assert drained(order) == ["b"]


def test_expected_stream_that_never_comes_is_given_up():
    order = StampOrder(hold_ns=100, jump_ns=50)
    order.expect("dvl", 1000)
    order.add("imu", 1000, "a")
    order.add("imu", 1101, "b")
    assert drained(order) == ["a", "b"]
