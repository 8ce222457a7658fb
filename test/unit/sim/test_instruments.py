import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig, measure, steel_deflection
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig, drive
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

PERFECT = InstrumentConfig(
    yaw_noise_rad=0.0,
    gyro_noise_rad_s=0.0,
    gyro_bias_deg_h=0.0,
    gyro_bias_walk_deg_h=0.0,
    angle_walk_deg_sqrt_h=0.0,
    dvl_noise_m_s=0.0,
    dvl_scale_sigma=0.0,
    dvl_bias_m_s=0.0,
    dvl_misalignment_rad=0.0,
    dvl_dropouts_per_min=0.0,
    dvl_outlier_share=0.0,
    depth_noise_m=0.0,
)


@pytest.fixture(scope="module")
def motion():
    """A hundred seconds of bends to both sides."""
    x = np.arange(0.0, 150.0, 0.25)
    route = np.column_stack([x, 8.0 * np.sin(x / 10.0)])
    return drive(route, 1_000, 100.0, DriveConfig(), np.random.default_rng(0))


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


def test_bottom_lock_is_lost_as_often_and_long_as_told(motion):
    config = replace(PERFECT, dvl_dropouts_per_min=6.0, dvl_dropout_s=2.0)
    lost, gaps = [], 0
    for seed in range(60):
        log = measure(motion, config, SE2(), np.random.default_rng(seed))
        is_lost = np.isnan(log.dvl_velocity_m_s).any(axis=1)
        lost.append(is_lost.mean())
        gaps += int((np.diff(is_lost.astype(int)) == 1).sum())
    # Losses come at random, 0.1 per second, and last 2 s: some run into each other. The part
    # without any is exp(-0.1 * 2) of the time.
    assert np.mean(lost) == pytest.approx(1.0 - math.exp(-0.2), rel=0.15)
    assert gaps / 60 == pytest.approx(10.0 * math.exp(-0.2), rel=0.15)


def test_outliers_are_rare_and_large(motion):
    config = replace(PERFECT, dvl_outlier_share=0.05)
    errors = np.concatenate(
        [
            measure(motion, config, SE2(), np.random.default_rng(seed)).dvl_velocity_m_s
            - motion.at(
                measure(motion, PERFECT, SE2(), np.random.default_rng(0)).dvl_stamp_ns
            ).velocity_m_s
            for seed in range(10)
        ]
    )
    size = np.hypot(*errors.T)
    assert (size > 1e-6).mean() == pytest.approx(0.05, rel=0.2)
    assert np.median(size[size > 1e-6]) == pytest.approx(0.5 * 1.177, rel=0.2)


def steel_wall():
    """A wall along a line to the north east, in pieces of a metre."""
    builder = WorldBuilder()
    s = np.arange(-20.0, 21.0)[:, None] * math.sqrt(0.5)
    builder.add(Surface("steel", 0.0, 8.0), np.hstack([s, -s]))
    return builder.build("wall", 0, (5.0, 5.0), 8.0)


def test_steel_turns_a_compass_when_it_is_near():
    # Seen from the south west, the middle of the wall lies to the north east: 45 degrees
    # clockwise from north.
    distances = np.array([3.0, 6.0, 12.0, 50.0])
    points = -distances[:, None] * np.full(2, math.sqrt(0.5))
    deflection = steel_deflection(steel_wall(), points)
    size = np.abs(deflection)
    assert 0.85 < size[0] < 1.05
    assert (np.diff(size) < 0.0).all()
    assert size[-1] < 0.01
    # On the other side the line of sight is turned by half a circle, and the effect the same.
    np.testing.assert_allclose(steel_deflection(steel_wall(), -points), deflection, atol=1e-12)


def test_a_compass_does_not_drift_but_is_deflected(motion):
    config = replace(
        PERFECT, heading_source="compass", gyro_bias_deg_h=500.0, compass_offset_rad=0.0
    )
    truth = motion.at(measure(motion, config, SE2(), np.random.default_rng(0)).imu_stamp_ns)
    free = measure(motion, config, SE2(), np.random.default_rng(0))
    np.testing.assert_allclose(free.yaw_rad, truth.poses[:, 2], atol=1e-9)
    near = measure(motion, config, SE2(), np.random.default_rng(0), steel_wall())
    error = near.yaw_rad - truth.poses[:, 2]
    expected = config.compass_deflection_rad * steel_deflection(steel_wall(), truth.poses[:, :2])
    np.testing.assert_allclose(error, expected, atol=1e-9)
    assert np.abs(error).max() > math.radians(2.0)
