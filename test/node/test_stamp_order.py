"""Messages leave in the order of their stamps, whatever order they come in."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.ros.mapper.stamp_order import StampOrder

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
    order = StampOrder(hold_ns=FOREVER, back_ns=FOREVER)
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
    order = StampOrder(hold_ns=FOREVER, back_ns=FOREVER)
    order.add("imu", 5, "imu 5")
    order.advance("dvl", 3)
    order.add("imu", 10, "imu 10")
    assert drained(order) == []
    order.add("dvl", 7, "dvl 7")
    assert drained(order) == ["imu 5", "dvl 7"]


def test_dead_stream_is_not_waited_for():
    order = StampOrder(hold_ns=100, back_ns=FOREVER)
    order.advance("dvl", 10)
    order.add("imu", 100, "a")
    assert drained(order) == []
    order.add("imu", 111, "b")
    assert drained(order) == ["a", "b"]


@pytest.mark.parametrize("names", [("dvl", "imu", "sonar"), ("sonar", "imu", "dvl")])
def test_equal_stamps_leave_by_the_name_of_their_stream(names):
    order = StampOrder(hold_ns=0, back_ns=FOREVER)
    for name in names:
        order.add(name, 5, name)
    order.add("dvl", 5, "dvl again")
    assert drained(order) == ["dvl", "dvl again", "imu", "sonar"]


def test_late_item_is_counted_and_leaves_at_once():
    order = StampOrder(hold_ns=0, back_ns=FOREVER)
    order.add("imu", 200, "a")
    assert drained(order) == ["a"]
    order.add("dvl", 50, "late")
    assert order.num_late == 1
    assert drained(order) == ["late"]


def jumping():
    """Two streams that have come to 1000; a jump is believed after 30."""
    order = StampOrder(hold_ns=100, back_ns=100, ahead_ns=200, believe_ns=30)
    for name in ("imu", "dvl"):
        assert not order.offer(name, 1000, f"{name} 1000")
    drained(order)
    return order


@pytest.mark.parametrize("stamp", [899, 1201])
def test_a_single_stamp_far_away_is_late_and_changes_nothing(stamp):
    order = jumping()
    assert not order.offer("imu", stamp, "wrong")
    assert drained(order) == []
    assert not order.offer("imu", 1010, "right")
    assert not order.offer("dvl", 1010, "also")
    assert drained(order) == ["also", "right"]
    assert order.num_late == 1


@pytest.mark.parametrize("stamp", [900, 1200])
def test_a_stamp_that_is_not_far_away_is_taken_as_it_is(stamp):
    order = jumping()
    assert not order.offer("imu", stamp, "near")
    assert order.displaced == {}


@pytest.mark.parametrize("start", [500, 5000])
def test_a_clock_that_all_follow_was_set(start):
    order = jumping()
    order.offer("imu", 1010, "old")
    assert not order.offer("imu", start, "a")
    assert not order.offer("dvl", start + 5, "b")
    assert not order.offer("imu", start + 29, "c")
    assert order.offer("imu", start + 30, "d")
    assert list(order.rest()) == ["old"]
    order.begin_anew()
    assert drained(order) == ["a", "b"]  # as far as the other one has come
    assert not order.offer("dvl", start + 31, "e")
    assert drained(order) == ["c", "d"]
    assert order.num_late == 0


def test_after_a_jump_those_are_waited_for_that_have_not_followed_yet():
    order = jumping()
    order.offer("imu", 500, "a")
    assert not order.offer("imu", 629, "b")
    assert order.offer("imu", 630, "c")
    order.begin_anew()
    order.offer("dvl", 605, "d")
    assert drained(order) == ["a", "d"]


def test_queues_that_are_emptied_one_after_the_other_make_one_jump():
    order = jumping()
    for name in ("dvl", "imu"):
        said = [order.offer(name, stamp, f"{name} {stamp}") for stamp in (1010, 5000, 5030)]
        assert said == [False, False, name == "imu"]
    assert list(order.rest()) == ["dvl 1010", "imu 1010"]
    order.begin_anew()
    assert drained(order) == ["dvl 5000", "imu 5000", "dvl 5030", "imu 5030"]


def test_a_jump_that_one_sensor_makes_alone_is_none():
    """Its messages are left out, and it is told whose they are."""
    order = jumping()
    for i in range(40):
        assert not order.offer("imu", 500 + 10 * i, "wrong")
        assert not order.offer("dvl", 1010 + 10 * i, f"dvl {i}")
    assert order.displaced == {"imu": 40}


def test_late_messages_of_a_burst_are_no_jump():
    order = jumping()
    for i in range(20):
        assert not order.offer("imu", 700 + i, "late")
    assert not order.offer("imu", 1020, "in time")
    assert order.num_late == 20


def test_a_first_message_is_never_displaced():
    order = StampOrder(hold_ns=10, back_ns=100, ahead_ns=200)
    order.expect("dvl", 1000)
    assert not order.offer("imu", 50_000, "a")
    assert not order.offer("dvl", 10, "b")
    assert order.displaced == {}


def test_expected_stream_is_waited_for_from_the_start_on():
    order = StampOrder(hold_ns=100, back_ns=50)
    order.expect("dvl", 1000)
    order.add("imu", 1000, "a")
    order.add("imu", 1099, "b")
    assert drained(order) == ["a"]
    order.add("dvl", 1050, "c")
    assert drained(order) == ["c"]
    order.expect("imu", 5000)  # heard of already: nothing changes
    order.add("dvl", 1100, "d")
    assert drained(order) == ["b"]


def test_expected_stream_that_never_comes_is_given_up():
    order = StampOrder(hold_ns=100, back_ns=50)
    order.expect("dvl", 1000)
    order.add("imu", 1000, "a")
    order.add("imu", 1101, "b")
    assert drained(order) == ["a", "b"]
