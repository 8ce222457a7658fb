"""Readings of other conventions, corrected, are those that were meant."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.conventions import CorrectedMountings, correct
from uw_dslam_ros2.io.feeding import feed
from uw_dslam_ros2.io.readings import (
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    PoseEvent,
    VelocityEvent,
)

SECOND = 1_000_000_000
KEY = ("auv_1", 100 * SECOND, "frame")


def imu(yaw, rates=(0.1, 0.2, 0.3)):
    q = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
    return ImuEvent(*KEY, q, 0.01, np.array(rates))


def velocity(x, y, z=0.0):
    return VelocityEvent(*KEY, np.array([x, y, z]), np.diag([1.0, 2.0, 3.0]))


def image():
    intensity = np.arange(12, dtype=np.uint16).reshape(4, 3)
    return ImageEvent(
        *KEY, SonarImage(KEY[1], intensity, np.arange(1.0, 5.0), np.array([0.5, 0.0, -0.4]))
    )


@pytest.mark.parametrize("event", [imu(1.0), velocity(1.0, 2.0), image(), DepthEvent(*KEY, 3.0)])
def test_the_defaults_change_nothing(event):
    result = correct(event, Conventions())
    for name in type(event).__slots__:
        if name != "image":
            np.testing.assert_array_equal(getattr(result, name), getattr(event, name))


def test_a_heading_from_north_becomes_a_yaw_from_east():
    # A heading of 30 degrees east of north, turning to starboard.
    event = imu(math.radians(30.0), (0.1, 0.2, 0.3))
    result = correct(event, Conventions(imu_orientation="ned", imu_rates="frd"))
    assert result.yaw_rad == pytest.approx(math.radians(60.0))
    np.testing.assert_allclose(result.angular_velocity_rad_s, [0.1, -0.2, -0.3])


def test_a_bow_up_stays_up_from_ned():
    # Nose up by 0.2 in forward-right-down axes is a positive pitch about y to starboard.
    event = ImuEvent(*KEY, np.array([0.0, math.sin(0.1), 0.0, math.cos(0.1)]), None, None)
    x, y, z, w = correct(event, Conventions(imu_orientation="ned")).orientation_xyzw
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    np.testing.assert_allclose(forward, [0.0, math.cos(0.2), math.sin(0.2)], atol=1e-12)


def test_a_pose_in_ned_becomes_one_in_enu():
    # 1 m north and 2 m east of the origin, heading 30 degrees, 3 m deep.
    covariance = np.array([[4.0, 0.5, 0.1], [0.5, 9.0, 0.2], [0.1, 0.2, 1.0]])
    said = PoseEvent(
        *KEY,
        "base_link",
        SE2(1.0, 2.0, math.radians(30.0)),
        covariance,
        np.array([1.0, 0.2, 0.3]),
        height_m=3.0,
    )
    assert correct(said, Conventions()) is said
    meant = correct(said, Conventions(odometry="ned"))
    assert meant.T_frame_base.as_array() == pytest.approx([2.0, 1.0, math.radians(60.0)])
    np.testing.assert_allclose(
        meant.covariance, [[9.0, 0.5, -0.2], [0.5, 4.0, -0.1], [-0.2, -0.1, 1.0]]
    )
    np.testing.assert_allclose(meant.velocity_m_s, [1.0, -0.2, -0.3])
    assert meant.height_m == -3.0


def test_what_is_not_filled_is_not_used():
    assert correct(imu(1.0), Conventions(imu_orientation="none")).orientation_xyzw is None
    assert correct(imu(1.0), Conventions(imu_rates="none")).angular_velocity_rad_s is None
    assert correct(imu(1.0), Conventions(imu_rates="none", imu_orientation="none")) is None
    degrees = correct(imu(1.0), Conventions(imu_rates_in_degrees=True))
    np.testing.assert_allclose(degrees.angular_velocity_rad_s, np.radians([0.1, 0.2, 0.3]))


def test_velocities_are_scaled_and_dropped():
    result = correct(velocity(100.0, 50.0), Conventions(velocity_scale=0.01))
    np.testing.assert_allclose(result.velocity_m_s, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(np.diag(result.covariance), [1e-4, 2e-4, 3e-4])
    conventions = Conventions(velocity_zero_is_invalid=True)
    assert correct(velocity(0.0, 0.0, 0.0), conventions) is None
    assert correct(velocity(0.1, 0.0), conventions) is not None


def test_pings_are_mirrored_scaled_and_put_in_time():
    conventions = Conventions(sonar_is_mirrored=True, sonar_range_scale=1.1, sonar_delay_s=0.25)
    result = correct(image(), conventions)
    assert result.stamp_ns == result.image.stamp_ns == 100 * SECOND - SECOND // 4
    np.testing.assert_allclose(result.image.bearing_rad, [-0.5, 0.0, 0.4])
    np.testing.assert_allclose(result.image.range_m, 1.1 * np.arange(1.0, 5.0))
    points = correct(PointsEvent(*KEY, np.array([[1.0, 2.0]])), conventions)
    np.testing.assert_allclose(points.points, [[1.1, -2.2]])


def test_mountings_turn_as_seen_from_above_whatever_the_instruments_axes():
    conventions = Conventions(velocity_yaw_offset_rad=0.5 * math.pi)
    downward = np.diag([1.0, -1.0, -1.0, 1.0])
    for mounting in (np.eye(4), downward):
        turned = CorrectedMountings(conventions).of(velocity(1.0, 0.0), mounting)
        np.testing.assert_allclose(turned[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert CorrectedMountings(conventions).of(image(), downward) is downward
    mirrored = Conventions(velocity_is_mirrored=True, velocity_yaw_offset_rad=0.5 * math.pi)
    turned = CorrectedMountings(mirrored).of(velocity(1.0, 2.0), np.eye(4))
    np.testing.assert_allclose(turned[:3, :3] @ [1.0, 2.0, 0.0], [2.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, -150.0])
@pytest.mark.parametrize("is_ned", [False, True])
def test_velocities_along_the_worlds_axes_are_turned_back_by_the_heading(yaw_deg, is_ned):
    yaw = math.radians(yaw_deg)
    v_world = [math.cos(yaw) - 0.3 * math.sin(yaw), math.sin(yaw) + 0.3 * math.cos(yaw)]
    changes = {"velocity_axes": "world"}
    if is_ned:
        v_world = v_world[::-1]
        changes |= {"velocity_is_mirrored": True, "velocity_yaw_offset_rad": 0.5 * math.pi}
    corrected = CorrectedMountings(Conventions(**changes))
    assert corrected.of(velocity(*v_world), np.eye(4)) is None  # no heading yet
    corrected.of(
        ImuEvent(*KEY, np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]), None, None),
        np.eye(4),
    )
    turned = corrected.of(velocity(*v_world), np.eye(4))
    np.testing.assert_allclose(turned[:3, :3] @ [*v_world, 0.0], [1.0, 0.3, 0.0], atol=1e-9)


def test_a_sonar_that_was_knocked_is_turned_from_then_on():
    for at_s, angle in ((99.0, 0.3), (101.0, 0.0)):
        conventions = Conventions(sonar_knocked_at_s=at_s, sonar_knocked_yaw_rad=0.3)
        turned = CorrectedMountings(conventions).of(image(), np.eye(4))
        assert math.atan2(turned[1, 0], turned[0, 0]) == pytest.approx(angle)


def test_a_heading_that_drifts_is_turned_back_from_its_stamp_on():
    conventions = Conventions(imu_drift_rad_s=0.01, imu_drift_since_s=60.0, imu_delay_s=20.0)
    event = correct(imu(1.0), conventions)
    assert (event.drift_rad_s, event.drift_rad) == pytest.approx((0.01, 0.2))
    said = []
    mapper = SimpleNamespace(
        attitude_at=lambda _: None, add_attitude=lambda *_: None, add_imu=lambda *a: said.append(a)
    )
    plain = correct(imu(1.0), Conventions())
    for mounting in (np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])):
        for reading in (event, plain):
            feed(mapper, reading, mounting)
        (_, yaw, rate, _), (_, yaw_before, rate_before, _) = said[-2:]
        assert yaw - yaw_before == pytest.approx(-0.2)
        assert rate - rate_before == pytest.approx(-0.01)


def test_bearings_are_scaled_about_the_middle_of_the_fan():
    result = correct(image(), Conventions(sonar_bearing_scale=0.5, sonar_is_mirrored=True))
    np.testing.assert_allclose(result.image.bearing_rad, [-0.25, 0.0, 0.2])
