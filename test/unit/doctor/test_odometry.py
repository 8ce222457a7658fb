"""Poses of the vehicle's own filter, where they are all the navigation that there is."""

import math
from dataclasses import replace

import numpy as np
import pytest
from unit.doctor.made_up_vehicle import drive, vehicle

from uw_dslam_ros2.core.doctor import NavigationSample, PingSample, examine
from uw_dslam_ros2.core.doctor.judging.odometry import OdometrySample

NONE = NavigationSample(*(np.empty(0),) * 4, np.empty((0, 2)))
DEEP_M = 2.0


@pytest.fixture(scope="module", params=(1, 2))
def pings(request):
    return vehicle(request.param)[1]


def poses(height_m=-DEEP_M):
    stamp_s = np.arange(0.0, 60.0, 0.1)
    yaw, _, body = drive(stamp_s)
    return OdometrySample(stamp_s, yaw + 0.3, stamp_s, body, np.full(len(stamp_s), height_m))


def in_ned(odometry):
    return replace(
        odometry,
        yaw_rad=0.5 * math.pi - odometry.yaw_rad,
        velocity_m_s=odometry.velocity_m_s * [1.0, -1.0],
        height_m=-odometry.height_m,
    )


def mirrored(pings):
    points = tuple(p * [1.0, -1.0] for p in pings.points)
    return PingSample(pings.stamp_s, points, pings.T_base_sonar)


def found(pings, odometry):
    result = examine(NONE, pings, "auv_1", odometry)
    return [f.kind for f in result.findings if f.severity != "info"], result.conventions.changes()


@pytest.mark.parametrize("height_m", [-DEEP_M, 0.0, math.nan])
def test_nothing_is_said_of_good_poses(pings, height_m):
    assert found(pings, poses(height_m)) == ([], {})


def test_poses_in_ned_are_told_by_the_side_of_the_surface(pings):
    assert found(pings, in_ned(poses())) == (["odometry_ned"], {"odometry": "ned"})


def test_a_frame_that_is_named_ned_is_no_reason_to_worry(pings):
    odometry = replace(in_ned(poses(math.nan)), is_named_ned=True)
    assert found(pings, odometry) == ([], {"odometry": "ned"})
    assert found(pings, replace(poses(), is_named_ned=True)) == ([], {})


def test_a_mirrored_sonar_is_told_from_poses_in_ned(pings):
    kinds, changes = found(mirrored(pings), poses())
    assert (kinds[0], changes["sonar_is_mirrored"]) == ("sonar_mirrored", True)


def test_without_a_height_both_are_named_and_the_likelier_is_taken(pings):
    assert found(pings, in_ned(poses(0.0))) == (["handedness"], {"odometry": "ned"})
    kinds, changes = found(mirrored(pings), poses(math.nan))
    assert (kinds[0], changes["odometry"]) == ("handedness", "ned")


def test_the_sonars_clock_direction_and_scale_are_judged_by_the_poses(pings):
    late = PingSample(pings.stamp_s + 0.5, pings.points, pings.T_base_sonar)
    kinds, changes = found(late, in_ned(poses()))
    assert kinds == ["odometry_ned", "sonar_delay"]
    assert changes["sonar_delay_s"] == pytest.approx(0.5, abs=0.05)
    cos, sin = math.cos(0.5), math.sin(0.5)
    turned = tuple(p @ np.array([[cos, sin], [-sin, cos]]) for p in pings.points)
    kinds, changes = found(PingSample(pings.stamp_s, turned, pings.T_base_sonar), poses())
    assert kinds == ["sonar_turned"]
    assert changes["sonar_yaw_offset_rad"] == pytest.approx(-0.5, abs=0.05)
    large = tuple(1.06 * p for p in pings.points)
    kinds, changes = found(PingSample(pings.stamp_s, large, pings.T_base_sonar), poses())
    assert kinds == ["sound_speed"]
    assert changes["sonar_range_scale"] == pytest.approx(1.0 / 1.06, abs=0.02)


def test_few_poses_say_nothing(pings):
    odometry = poses()
    few = replace(odometry, stamp_s=odometry.stamp_s[:5], yaw_rad=odometry.yaw_rad[:5])
    assert found(pings, few) == ([], {})
