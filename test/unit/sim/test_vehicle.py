import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig, drive

STILL = DriveConfig(current_m_s=0.0)


def route():
    """A hundred metres with bends both ways, and a hairpin."""
    s = np.linspace(0.0, 1.0, 400)[:, None]
    there = np.hstack([60.0 * s, 8.0 * np.sin(6.0 * s)])
    back = np.hstack([60.0 - 60.0 * s[1:], 8.0 * np.sin(6.0 - 6.0 * s[1:]) + 0.5 * s[1:]])
    points = np.vstack([there, back])
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    even = np.linspace(0.0, lengths[-1], round(lengths[-1] / 0.25))
    return np.column_stack([np.interp(even, lengths, points[:, i]) for i in range(2)])


@pytest.fixture(scope="module")
def motion():
    return drive(route(), 1_000, 100.0, STILL, np.random.default_rng(0))


def integrate(yaw, velocity, dt, start):
    """Dead reckoning in the plainest way: trapezoids of velocities turned by the yaw."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    world = np.column_stack(
        [
            cos * velocity[:, 0] - sin * velocity[:, 1],
            sin * velocity[:, 0] + cos * velocity[:, 1],
        ]
    )
    steps = 0.5 * (world[1:] + world[:-1]) * dt
    return start + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def test_velocities_integrate_to_the_positions(motion):
    track = integrate(motion.poses[:, 2], motion.velocity_m_s, 0.02, motion.poses[0, :2])
    assert np.hypot(*(track - motion.poses[:, :2]).T).max() < 0.001
    turned = np.cumsum(motion.yaw_rate_rad_s) * 0.02
    assert np.abs(turned - (motion.poses[:, 2] - motion.poses[0, 2])).max() < 0.01


def test_the_vehicle_keeps_its_limits(motion):
    speed = np.hypot(*motion.velocity_m_s.T)
    assert speed.max() < 1.15 * STILL.speed_m_s
    assert np.abs(motion.yaw_rate_rad_s).max() < 1.2 * STILL.max_yaw_rate_rad_s
    # Mostly it goes ahead.
    assert np.median(motion.velocity_m_s[:, 0] / speed) > 0.95


def test_a_route_that_is_too_short_is_refused():
    with pytest.raises(InvalidInputError, match=r"the route is .* m long and ends after"):
        drive(route()[:40], 0, 100.0, STILL, np.random.default_rng(0))


def test_the_bow_points_into_the_current():
    # Water that flows north pushes a vehicle that goes east to port: the bow turns to starboard
    # by asin(0.3 / 1.0) = 17.5 degrees, and the way over ground stays the same.
    config = DriveConfig(current_m_s=0.3, current_yaw_rad=0.5 * np.pi)
    straight = np.column_stack([np.arange(0.0, 200.0, 0.25), np.zeros(800)])
    drifting = drive(straight, 0, 60.0, config, np.random.default_rng(0))
    still = drive(straight, 0, 60.0, STILL, np.random.default_rng(0))
    np.testing.assert_allclose(drifting.poses[:, :2], still.poses[:, :2])
    crab = drifting.poses[:, 2] - still.poses[:, 2]
    np.testing.assert_allclose(np.degrees(crab), -17.46, atol=0.01)
    track = integrate(drifting.poses[:, 2], drifting.velocity_m_s, 0.02, drifting.poses[0, :2])
    assert np.hypot(*(track - drifting.poses[:, :2]).T).max() < 0.001
