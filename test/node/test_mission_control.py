"""What a demo tells of mappers that it did not have to watch."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.cli import demo
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.ros.plumbing.mission_control import MissionControl
from uw_dslam_ros2.ros.plumbing.sensor_inputs import check_stamp

pytestmark = pytest.mark.ros
S = 10**9


def notes_on(num_bad, run_ids):
    submaps = [SimpleNamespace(vehicle_id="auv_1", run_id=run) for run in run_ids]
    submaps.append(SimpleNamespace(vehicle_id="auv_2", run_id=99))
    control = SimpleNamespace(status=SimpleNamespace(submaps=submaps))
    return MissionControl.notes_on(control, {"auv_1": {"num_bad": str(num_bad)}})


def test_nothing_is_noted_where_nothing_went_wrong():
    assert notes_on(0, [7, 7]) == []


def test_messages_that_were_left_out_and_runs_that_broke_are_noted():
    (bad,) = notes_on(10, [7])
    assert bad.startswith("auv_1 left 10 bad messages out")
    (broken,) = notes_on(0, [7, 8, 7])
    assert "auv_1 began anew" in broken
    assert "2 runs" in broken


def at(seconds):
    stamp = SimpleNamespace(sec=seconds, nanosec=0)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp))


def test_a_clock_as_late_as_a_player_lets_a_mapper_lag_refuses_nothing():
    check_stamp(at(100 + int(demo._MAX_LAG_S)), 100 * S)
    with pytest.raises(InvalidInputError, match="ahead of the clock"):
        check_stamp(at(100 + 3600), 100 * S)
