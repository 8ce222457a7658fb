"""Messages leave in the order of their stamps, whatever order they come in."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.ros.stamp_order import StampOrder

pytestmark = pytest.mark.ros


def drained(order):
    items = []
    while (item := order.peek()) is not None:
        assert order.pop() == item
        items.append(item)
    return items


@pytest.mark.parametrize("seed", range(5))
def test_any_arrival_within_the_hold_gives_the_same_order(seed):
    rng = np.random.default_rng(seed)
    stamps = rng.permutation(1000)[:200] * 10
    arrival = np.argsort(stamps + rng.uniform(0, 500, len(stamps)))
    order = StampOrder(hold_ns=500, jump_ns=10**9)
    got = []
    for index in arrival:
        order.add("sonar", int(stamps[index]), int(stamps[index]))
        got += drained(order)
    got += list(order.rest())
    assert got == sorted(stamps.tolist())
    assert order.num_late == 0


def test_nothing_leaves_before_its_time():
    order = StampOrder(hold_ns=100, jump_ns=10**9)
    order.add("imu", 1000, "first")
    order.add("dvl", 1099, "second")
    assert drained(order) == []
    order.add("imu", 1100, "third")
    assert drained(order) == ["first"]


def test_equal_stamps_keep_their_arrival():
    order = StampOrder(hold_ns=0, jump_ns=10**9)
    order.add("a", 5, "x")
    order.add("b", 5, "y")
    assert drained(order) == ["x", "y"]


def test_late_item_is_counted_and_leaves_at_once():
    order = StampOrder(hold_ns=10, jump_ns=10**9)
    order.add("imu", 100, "a")
    order.add("imu", 200, "b")
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
