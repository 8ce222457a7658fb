"""Costly work is spread over time."""

import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.ros.plumbing import throttle
from uw_dslam_ros2.ros.plumbing.throttle import Throttle

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(("cost_s", "due_s"), [(0.0, 2.0), (0.1, 2.0), (1.0, 11.0)])
def test_work_is_due_after_its_period_and_ten_times_its_cost(monkeypatch, cost_s, due_s):
    now_s = 100.0
    monkeypatch.setattr(throttle.time, "monotonic", lambda: now_s)
    drawing = Throttle(2.0)
    assert drawing.is_due()
    with drawing.turn():
        now_s += 50.0  # code is loaded: what that takes says nothing of the next turn
    assert drawing.is_due()
    now_s = 100.0
    with drawing.turn():
        now_s += cost_s
    now_s = 100.0 + due_s - 1e-6
    assert not drawing.is_due()
    now_s = 100.0 + due_s + 1e-6
    assert drawing.is_due()
