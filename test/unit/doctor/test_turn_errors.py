"""Echoes that turn with the IMU by another factor, or only in another unit."""

from dataclasses import replace

import numpy as np
import pytest
from unit.doctor.made_up_vehicle import vehicle

from uw_dslam_ros2.core.doctor import PingSample, examine
from uw_dslam_ros2.core.doctor.motions.fits import fit_turns
from uw_dslam_ros2.core.doctor.motions.ping_motion import ping_motions
from uw_dslam_ros2.core.doctor.motions.turn_errors import fit_turn_errors


def spread(pings, factor):
    points = []
    for xy in pings.points:
        bearing, range_m = factor * np.arctan2(xy[:, 1], xy[:, 0]), np.hypot(*xy.T)
        points.append(np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing)]))
    return PingSample(pings.stamp_s, tuple(points), pings.T_base_sonar)


@pytest.mark.parametrize("seed", [1, 2])
def test_drift_and_scale_are_told_apart(seed):
    navigation, pings = vehicle(seed)
    motions = ping_motions(pings, 0.7, 2.1)
    yaw = 1.05 * np.unwrap(navigation.yaw_rad) + 0.01 * navigation.imu_s
    found = fit_turn_errors(
        motions, navigation.imu_s, yaw, fit_turns(motions, navigation.imu_s, yaw)[0]
    )
    assert found.bias_rad_s == pytest.approx(0.01, abs=5.0 * found.bias_sigma_rad_s)
    assert found.scale == pytest.approx(0.95, abs=0.01)
    assert found.bias_sigma_rad_s < 1e-3


@pytest.mark.parametrize("factor", [0.75, 0.93, 1.07, 1.3])
def test_bearings_over_another_aperture_are_told_and_mended(factor):
    navigation, pings = vehicle(1)
    found = examine(navigation, spread(pings, factor))
    assert [finding.kind for finding in found.findings] == ["sonar_aperture"]
    assert found.conventions.sonar_bearing_scale == pytest.approx(1.0 / factor, rel=0.05)


def test_rates_in_degrees_are_told_without_an_orientation():
    navigation, pings = vehicle(1)
    alone = replace(
        navigation,
        yaw_rad=np.full_like(navigation.yaw_rad, np.nan),
        yaw_rate_rad_s=np.degrees(navigation.yaw_rate_rad_s),
    )
    found = examine(alone, pings)
    assert [finding.kind for finding in found.findings] == ["imu_rates_in_degrees"]
    assert found.conventions.imu_rates_in_degrees
