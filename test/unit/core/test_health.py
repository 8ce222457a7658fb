"""What is told of a vehicle, by its counters alone."""

from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.clocks import Gap
from uw_dslam_ros2.core.health import MappedVehicle, SensorCount, health_findings

SECOND = 1_000_000_000
COUNTS = {
    "num_submaps": 2, "num_pings": 360, "num_pings_dropped": 2, "num_pings_empty": 3,
    "num_key_pings": 100, "num_matches": 80, "num_imu_used": 6000, "num_imu_outliers": 20,
    "num_velocity_used": 720, "num_velocity_outliers": 9,
}  # fmt: skip
SENSORS = {
    "sonar": SensorCount(362),
    "imu": SensorCount(3000),
    "velocity": SensorCount(720, num_empty=40),
    "depth": SensorCount(600),
}
STAMPS = np.arange(0, 121) * SECOND
WAY = np.column_stack([0.5 * np.arange(121), np.zeros((121, 2))])
GOOD = MappedVehicle(
    "auv_1",
    SENSORS,
    COUNTS,
    spans=dict.fromkeys(SENSORS, (0, 120 * SECOND)),
    trajectory_stamp_ns=STAMPS,
    trajectory=WAY,
)


def found(**changes):
    return [(f.kind, f.role) for f in health_findings(replace(GOOD, **changes))]


def without(role):
    return {name: count for name, count in SENSORS.items() if name != role}


def test_nothing_is_told_where_nothing_is_wrong():
    assert found() == []
    assert found(sensors=without("depth")) == []


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"sensors": without("imu")}, ("no_heading", "imu")),
        ({"sensors": without("velocity")}, ("no_velocity", "velocity")),
        ({"has_yaw": False}, ("no_heading", "imu")),
        ({"sensors": SENSORS | {"imu": SensorCount(3000, 50)}}, ("bad_messages", "imu")),
        (
            {"sensors": SENSORS | {"velocity": SensorCount(720, num_empty=700)}},
            ("no_bottom_lock", "velocity"),
        ),
        ({"counts": COUNTS | {"num_pings_dropped": 1000}}, ("pings_dropped", "sonar")),
        ({"counts": COUNTS | {"num_pings_blind": 90}}, ("pings_blind", "imu")),
        ({"counts": COUNTS | {"num_pings_empty": 360}}, ("no_echoes", "sonar")),
        ({"counts": COUNTS | {"num_matches": 14}}, ("few_matches", "sonar")),
        ({"counts": COUNTS | {"num_imu_outliers": 9000}}, ("outliers", "imu")),
        ({"gaps": (Gap("imu", 40 * SECOND, 70 * SECOND),)}, ("gap", "imu")),
        (
            {"spans": GOOD.spans | {"imu": (3600 * SECOND, 3720 * SECOND)}},
            ("no_overlap", "imu"),
        ),
    ],
)
def test_one_thing_wrong_is_told_once(changes, told):
    assert found(**changes) == [told]


def test_a_gap_in_which_the_vehicle_stood_still_is_no_harm():
    gap = Gap("imu", 40 * SECOND, 70 * SECOND)
    assert found(gaps=(gap,), trajectory=np.zeros((121, 3))) == []


@pytest.mark.parametrize(("num_early", "is_told"), [(500, False), (300, True)])
def test_a_dvl_needs_no_lock_before_the_dive(num_early, is_told):
    count = SensorCount(720, num_empty=540, num_early=num_early)
    told = found(sensors=SENSORS | {"velocity": count})
    assert told == [("no_bottom_lock", "velocity")] * is_told


def test_a_filter_of_its_own_needs_no_imu_and_no_dvl():
    sensors = {"sonar": SENSORS["sonar"], "odometry": SensorCount(1200)}
    assert found(sensors=sensors, has_yaw=False, has_yaw_rate=False) == []


def test_an_odometry_that_says_nothing_replaces_no_dvl():
    sensors = without("velocity") | {"odometry": SensorCount(600, num_empty=600)}
    assert found(sensors=sensors) == [("empty_odometry", "odometry"), ("no_velocity", "velocity")]


def test_nothing_mapped_is_an_error_that_says_why():
    counts = {"num_submaps": 0}
    *_, last = health_findings(replace(GOOD, sensors=without("sonar"), counts=counts))
    assert (last.kind, last.severity) == ("nothing_mapped", "error")
    assert last.sentence.startswith("auv_1: nothing was mapped (sonar: there is no topic")


def test_velocities_that_come_seldom_are_told():
    for period_s, is_told in ((0.2, False), (2.0, False), (5.0, True)):
        vehicle = MappedVehicle(
            "auv_1",
            {role: SensorCount(25) for role in ("sonar", "imu", "velocity")},
            {"num_submaps": 1},
            spans={"velocity": (0, int(24 * period_s * 1e9))},
        )
        told = [f.kind for f in health_findings(vehicle)]
        assert told == (["seldom"] if is_told else [])
