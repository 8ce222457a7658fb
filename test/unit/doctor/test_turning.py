"""The zero, the direction and the heading's delay of a sonar that turns, found by its echoes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination, NavigationSample
from uw_dslam_ros2.core.doctor.judging.odometry import OdometrySample
from uw_dslam_ros2.core.doctor.turning.kernels import mean_nearness
from uw_dslam_ros2.core.doctor.turning.turns import BeamSample
from uw_dslam_ros2.core.doctor.turning.verdict import (
    choose_spans,
    examine_turning,
    examine_turning_by_odometry,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.missions.mission import (
    T_BASE_DVL,
    T_BASE_SONAR,
    MissionConfig,
    plan_mission,
)
from uw_dslam_ros2.sim.sonars.turning import TurningSonarConfig, beam_bearing_rad, counted_rad
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig

TURN = TurningSonarConfig(turn_s=14.0, num_beams=120, max_range_m=40.0)
SLOW = DriveConfig(speed_m_s=0.4, max_yaw_rate_rad_s=0.15, current_m_s=0.05)


def recording(seed, turning=TURN, delay_s=0.0, duration_s=700.0):
    """What the sonar, the DVL and an IMU of a slow vehicle in a basin say; times from 0 s."""
    config = MissionConfig(
        seed=seed,
        num_vehicles=1,
        duration_s=duration_s,
        sonar_kind="turning",
        turning=turning,
        drive=SLOW,
        instruments=InstrumentConfig(imu_rate_hz=10.0, dvl_rate_hz=2.0, imu_delay_s=delay_s),
    )
    mission = plan_mission(config)
    run, rng = mission.runs[0], np.random.default_rng(seed)
    rows = []
    for i, stamp_ns in enumerate(run.ping_motion.stamp_ns):
        bearing = beam_bearing_rad(turning, i)
        sonar = run.ping_motion.pose(i) @ T_BASE_SONAR
        ray = mission.world.cast((sonar.x, sonar.y), [sonar.yaw + bearing], 40.0).range_m[0]
        if math.isfinite(ray):
            rows.append((stamp_ns, counted_rad(turning, bearing), ray + rng.normal(0.0, 0.1)))
    start_ns, log = run.motion.stamp_ns[0], run.navigation

    def seconds(stamps):
        return (np.array([int(s) for s in stamps], np.int64) - start_ns) * 1e-9

    has_lock = np.isfinite(log.dvl_velocity_m_s).all(axis=1)
    navigation = NavigationSample(
        seconds(log.imu_stamp_ns),
        log.yaw_rad,
        log.yaw_rate_rad_s,
        seconds(log.dvl_stamp_ns[has_lock]),
        log.dvl_velocity_m_s[has_lock],
        (T_BASE_DVL.x, T_BASE_DVL.y),
    )
    stamps, bearing, range_m = zip(*rows, strict=True)
    beams = BeamSample(
        seconds(stamps), np.array(bearing), np.array(range_m), SE2(T_BASE_SONAR.x, T_BASE_SONAR.y)
    )
    return navigation, beams


def examined(navigation, beams):
    found = Examination(vehicle_id="auv_1")
    spans = choose_spans(navigation, beams.stamp_s)
    examine_turning(found, navigation, beams, spans)
    return found


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_is_said_of_a_recording_as_it_should_be(seed):
    found = examined(*recording(seed))
    assert found.num_turning_windows >= 4
    assert found.findings == []
    assert found.conventions == Conventions()


@pytest.mark.parametrize(("zero_deg", "seed"), [(94.0, 1), (-30.0, 2), (180.0, 3)])
def test_zero_direction_and_delay_are_found_together(zero_deg, seed):
    turning = replace(TURN, zero_rad=math.radians(zero_deg), is_clockwise=True)
    found = examined(*recording(seed, turning, delay_s=0.8))
    kinds = [finding.kind for finding in found.findings]
    assert kinds == ["sonar_mirrored", "sonar_turned", "imu_delay"]
    conventions = found.conventions
    assert conventions.sonar_is_mirrored
    # A bearing b, mirrored and turned, is what it means.
    off = conventions.sonar_yaw_offset_rad - turning.zero_rad
    assert abs(math.remainder(off, 2.0 * math.pi)) < math.radians(2.5)
    assert conventions.imu_delay_s == pytest.approx(0.8, abs=0.2)


@pytest.mark.parametrize(
    ("yaw_sign", "rate_sign", "expected"),
    [
        (-1.0, -1.0, {"imu_orientation": "ned", "imu_rates": "frd"}),
        (-1.0, 1.0, {"imu_orientation": "ned"}),
        (1.0, -1.0, {"imu_rates": "frd"}),
        (math.nan, -1.0, {"imu_rates": "frd"}),
        (-1.0, math.nan, {"imu_orientation": "ned"}),
    ],
)
def test_a_heading_that_grows_clockwise_is_the_imus(yaw_sign, rate_sign, expected):
    navigation, beams = recording(1)
    wrong = replace(
        navigation,
        yaw_rad=yaw_sign * navigation.yaw_rad,
        yaw_rate_rad_s=rate_sign * navigation.yaw_rate_rad_s,
    )
    assert examined(wrong, beams).conventions == Conventions(**expected)


@pytest.mark.parametrize(
    ("side", "height_m", "kinds"),
    [(1.0, -3.0, []), (-1.0, 3.0, ["odometry_ned"]), (-1.0, -3.0, ["sonar_mirrored"])],
)
def test_poses_of_a_filter_that_turn_against_the_sonar_are_told(side, height_m, kinds):
    navigation, beams = recording(2)
    odometry = OdometrySample(
        navigation.imu_s,
        side * navigation.yaw_rad,
        navigation.velocity_s,
        navigation.velocity_m_s * np.array([1.0, side]),
        np.full(len(navigation.imu_s), height_m),
    )
    found = Examination()
    spans = choose_spans(odometry.as_navigation(), beams.stamp_s)
    examine_turning_by_odometry(found, odometry, beams, spans)
    assert [f.kind for f in found.findings] == kinds


def test_the_zero_alone_is_found():
    turning = replace(TURN, zero_rad=math.radians(-60.0))
    found = examined(*recording(4, turning))
    assert [finding.kind for finding in found.findings] == ["sonar_turned"]
    assert found.conventions.sonar_yaw_offset_rad == pytest.approx(turning.zero_rad, abs=0.04)


def test_a_velocity_of_the_bottom_is_not_taken_for_a_turned_sonar():
    navigation, beams = recording(5)
    navigation = replace(navigation, velocity_m_s=-navigation.velocity_m_s)
    found = examined(navigation, beams)
    assert [finding.kind for finding in found.findings] == ["dvl_sign"]


@pytest.mark.parametrize("reason", ["stands", "short", "no heading"])
def test_where_turns_cannot_be_compared_nothing_is_said(reason):
    navigation, beams = recording(1)
    if reason == "stands":
        navigation = replace(navigation, velocity_m_s=0.0 * navigation.velocity_m_s)
    elif reason == "short":
        early = beams.stamp_s < 40.0
        beams = BeamSample(beams.stamp_s[early], beams.bearing_rad[early], beams.range_m[early])
    else:
        nothing = np.full(len(navigation.imu_s), np.nan)
        navigation = replace(navigation, yaw_rad=nothing, yaw_rate_rad_s=nothing)
    found = examined(navigation, beams)
    assert found.num_turning_windows == 0
    assert found.findings == []


def test_velocities_that_are_wrong_now_and_then_spoil_nothing():
    turning = replace(TURN, zero_rad=math.radians(94.0), is_clockwise=True)
    navigation, beams = recording(1, turning, delay_s=0.8)
    velocity = navigation.velocity_m_s.copy()
    velocity[::25] += 4.0
    found = examined(replace(navigation, velocity_m_s=velocity), beams)
    assert found.conventions.sonar_is_mirrored
    assert found.conventions.sonar_yaw_offset_rad == pytest.approx(turning.zero_rad, abs=0.05)


def test_a_delay_that_the_imu_shows_by_itself_is_told_once():
    navigation, beams = recording(2, delay_s=0.8)
    found = Examination(conventions=Conventions(imu_delay_s=0.8))
    examine_turning(found, navigation, beams, choose_spans(navigation, beams.stamp_s))
    assert found.findings == []


def test_a_velocity_that_is_silent_for_a_while_spoils_nothing():
    turning = replace(TURN, zero_rad=math.radians(94.0), is_clockwise=True)
    navigation, beams = recording(1, turning, delay_s=0.8)
    at_s = navigation.velocity_s
    is_heard = np.ones(len(at_s), bool)
    for begin_s in range(60, 660, 120):
        is_heard &= (at_s < begin_s) | (at_s > begin_s + 12.0)
    navigation = replace(
        navigation,
        velocity_s=at_s[is_heard],
        velocity_m_s=navigation.velocity_m_s[is_heard],
    )
    conventions = examined(navigation, beams).conventions
    assert conventions.sonar_is_mirrored
    assert conventions.sonar_yaw_offset_rad == pytest.approx(turning.zero_rad, abs=0.05)
    assert conventions.imu_delay_s == pytest.approx(0.8, abs=0.2)


def test_nearness_is_that_of_all_pairs_of_one_stretch_that_are_apart(rng):
    stamp_s, stretch = np.sort(rng.uniform(0.0, 20.0, 60)), np.repeat([0, 1, 2], 20)
    x, y = rng.normal(size=(2, 60))
    near = []
    for i in range(0, 60, 3):
        for j in range(i + 1, 60):
            if stretch[i] == stretch[j] and stamp_s[j] - stamp_s[i] > 2.0:
                squares = ((x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2) / 0.7**2
                near.append((1.0 + squares) ** -2)
    mean, count = mean_nearness(stamp_s, stretch, x, y, 2.0, 0.7, 3)
    assert count == len(near)
    assert mean == pytest.approx(np.mean(near))
    assert mean_nearness(stamp_s, stretch, x, y, 30.0, 0.7, 1) == (0.0, 0)


def test_a_delay_beyond_those_that_are_tried_is_told_and_not_mended():
    found = examined(*recording(2, delay_s=4.0))
    (finding,) = (f for f in found.findings if f.kind == "imu_delay")
    assert "2 s or more" in finding.detail
    assert found.conventions.imu_delay_s == 0.0
