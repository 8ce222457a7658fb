import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.vehicle import NavigationConfig, drive, measure

PERFECT = NavigationConfig(
    yaw_noise_rad=0.0,
    gyro_noise_rad_s=0.0,
    gyro_bias_deg_h=0.0,
    gyro_bias_walk_deg_h=0.0,
    angle_walk_deg_sqrt_h=0.0,
    dvl_noise_m_s=0.0,
    dvl_scale_sigma=0.0,
    dvl_bias_m_s=0.0,
    dvl_misalignment_rad=0.0,
    depth_noise_m=0.0,
)


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
    return drive(route(), 1_000, 100.0, PERFECT, np.random.default_rng(0))


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
    assert np.hypot(*(track - motion.poses[:, :2]).T).max() < 0.02
    turned = np.cumsum(motion.yaw_rate_rad_s) * 0.02
    assert np.abs(turned - (motion.poses[:, 2] - motion.poses[0, 2])).max() < 0.01


def test_the_vehicle_keeps_its_limits(motion):
    speed = np.hypot(*motion.velocity_m_s.T)
    assert speed.max() < 1.15 * PERFECT.speed_m_s
    assert np.abs(motion.yaw_rate_rad_s).max() < 1.2 * PERFECT.max_yaw_rate_rad_s
    # Mostly it goes ahead.
    assert np.median(motion.velocity_m_s[:, 0] / speed) > 0.95


def test_a_route_that_is_too_short_is_refused():
    with pytest.raises(InvalidInputError, match=r"the route is .* m long and ends after"):
        drive(route()[:40], 0, 100.0, PERFECT, np.random.default_rng(0))


def test_perfect_instruments_give_the_motion_up_to_the_start(motion):
    T_base_dvl = SE2(-0.4, 0.25, math.radians(30.0))
    log = measure(motion, PERFECT, T_base_dvl, np.random.default_rng(1))
    offset = log.yaw_rad - motion.at(log.imu_stamp_ns).poses[:, 2]
    np.testing.assert_allclose(offset, offset[0], atol=1e-9)
    # Back from the instrument to base_link, lever arm and mounting angle removed.
    yaw_rate = np.interp(log.dvl_stamp_ns, log.imu_stamp_ns, log.yaw_rate_rad_s)
    lever = np.column_stack([-0.25 * yaw_rate, -0.4 * yaw_rate])
    at_base = log.dvl_velocity_m_s @ T_base_dvl.rotation().T - lever
    truth = motion.at(log.dvl_stamp_ns)
    np.testing.assert_allclose(at_base, truth.velocity_m_s, atol=0.02)
    np.testing.assert_allclose(log.depth_m, motion.at(log.depth_stamp_ns).depth_m)


def test_each_vehicle_has_a_yaw_zero_of_its_own(motion):
    offsets = []
    for seed in range(40):
        log = measure(motion, PERFECT, SE2(), np.random.default_rng(seed))
        offsets.append(log.yaw_rad[0] - motion.poses[0, 2])
    # Spread over the whole circle: no mean direction.
    assert np.hypot(np.cos(offsets).mean(), np.sin(offsets).mean()) < 0.4


def many_yaw_errors(motion, config, count=200):
    rows = []
    for seed in range(count):
        log = measure(motion, config, SE2(), np.random.default_rng(seed))
        error = log.yaw_rad - motion.at(log.imu_stamp_ns).poses[:, 2]
        rows.append(error - error[0])
    return np.array(rows)


@pytest.mark.parametrize(
    ("config", "expected_rad"),
    [
        # A constant bias b grows the error as b t: 20 deg/h for 100 s.
        (replace(PERFECT, gyro_bias_deg_h=20.0), math.radians(20.0) * 100.0 / 3600.0),
        # Angle random walk grows as the root of time.
        (replace(PERFECT, angle_walk_deg_sqrt_h=0.3), math.radians(0.3 * math.sqrt(1 / 36))),
        # A bias that walks by q sqrt(t) integrates to q sqrt(t^3 / 3).
        (
            replace(PERFECT, gyro_bias_walk_deg_h=1000.0),
            math.radians(1000.0) / 3600.0 * math.sqrt(1 / 3600.0) * math.sqrt(100.0**3 / 3),
        ),
    ],
)
def test_yaw_drift_is_that_of_its_parameters(motion, config, expected_rad):
    errors = many_yaw_errors(motion, config)
    # 200 samples give a standard deviation to five per cent, one sigma.
    assert errors[:, -1].std() == pytest.approx(expected_rad, rel=0.2)
    assert abs(errors[:, -1].mean()) < 4.0 * expected_rad / math.sqrt(len(errors))


def test_rate_and_yaw_share_one_bias(motion):
    config = replace(PERFECT, gyro_bias_deg_h=200.0)
    log = measure(motion, config, SE2(), np.random.default_rng(3))
    truth = motion.at(log.imu_stamp_ns)
    bias = (log.yaw_rate_rad_s - truth.yaw_rate_rad_s).mean()
    drift = (log.yaw_rad - truth.poses[:, 2])[[0, -1]]
    assert drift[1] - drift[0] == pytest.approx(bias * 100.0, rel=0.01)


def test_dvl_errors_are_those_of_their_parameters(motion):
    config = replace(PERFECT, dvl_scale_sigma=0.01, dvl_misalignment_rad=0.02)
    scales, angles = [], []
    for seed in range(200):
        log = measure(motion, config, SE2(), np.random.default_rng(seed))
        truth = motion.at(log.dvl_stamp_ns).velocity_m_s
        z = (log.dvl_velocity_m_s @ [1, 1j]) / (truth @ [1, 1j])
        scales.append(np.abs(z).mean())
        angles.append(np.angle(z).mean())
    assert np.std(scales) == pytest.approx(0.01, rel=0.2)
    assert np.std(angles) == pytest.approx(0.02, rel=0.2)
    noisy = replace(PERFECT, dvl_noise_m_s=0.006)
    log = measure(motion, noisy, SE2(), np.random.default_rng(0))
    noise = log.dvl_velocity_m_s - motion.at(log.dvl_stamp_ns).velocity_m_s
    assert noise.std() == pytest.approx(0.006, rel=0.05)
