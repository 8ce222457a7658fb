"""Readings are examined as they come, a window at a time, with no more memory than that."""

from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.readings import ImuEvent, ScanEvent, VelocityEvent
from uw_dslam_ros2.io.watching import ReadingWatch
from uw_dslam_ros2.sim.missions.mission import MissionConfig, plan_mission
from uw_dslam_ros2.sim.missions.readings import MissionReadings, mounting_of

SECOND = 1_000_000_000


def turned_dvl(reading):
    """Forward and left of a DVL that is mounted a quarter turn off."""
    if isinstance(reading, VelocityEvent):
        x, y, z = reading.velocity_m_s
        return replace(reading, velocity_m_s=np.array([-y, x, z]))
    return reading


@pytest.mark.parametrize(("change", "kinds"), [(None, []), (turned_dvl, ["dvl_turned"])])
def test_a_window_is_examined_once(change, kinds):
    config = MissionConfig(seed=2, num_vehicles=1, duration_s=170.0, ping_rate_hz=1.0)
    watch = ReadingWatch(SonarConfig(), "auv_1")
    windows = []
    for reading in MissionReadings(plan_mission(config))(lambda *_: True):
        said = change(reading) if change else reading
        if (examination := watch.take(said, mounting_of(said))) is not None:
            windows.append(examination())
    (found,) = windows
    assert [finding.kind for finding in found.findings] == kinds
    assert found.num_ping_motions > 30


def imu(stamp_ns):
    return ImuEvent("auv_1", stamp_ns, "imu", np.array([0.0, 0.0, 0.0, 1.0]), None, np.ones(3))


def test_a_clock_that_jumps_begins_a_new_window():
    watch = ReadingWatch(SonarConfig(), "auv_1")
    stamps = [*range(100, 200), *range(0, 100), *range(5000, 5149)]
    assert all(watch.take(imu(s * SECOND), np.eye(4)) is None for s in stamps)
    examination = watch.take(imu(5150 * SECOND), np.eye(4))
    assert examination is not None
    assert [finding.kind for finding in examination().findings] == ["imu_no_orientation"]


def test_pings_beyond_one_a_second_cost_nothing(monkeypatch):
    fed = []
    monkeypatch.setattr("uw_dslam_ros2.io.watching.feed", lambda *args: fed.append(args[1]))
    watch = ReadingWatch(SonarConfig(), "auv_1")
    for tenth in range(101):
        scan = ScanEvent("auv_1", tenth * SECOND // 10, "sonar", np.zeros(1), np.ones(1), 5.0)
        watch.take(scan, np.eye(4))
    assert len(fed) == 11
