"""A made-up vehicle: exact navigation, and echoes of a place without symmetry."""

import numpy as np

from uw_dslam_ros2.core.doctor import NavigationSample, PingSample
from uw_dslam_ros2.core.se2 import SE2

SONAR = SE2(0.3, 0.1, 0.2)
DVL_LEVER = (-0.2, 0.05)
_RANGE_M = 18.0


def place(rng):
    """Points (N, 2) [m] along walls of many directions, 0.15 m apart."""
    walls = []
    for x in np.arange(-15.0, 75.0, 9.0):
        for y in (-14.0, 12.0):
            corner = np.array([x, y]) + rng.uniform(-2.0, 2.0, 2)
            for angle in rng.uniform(0.0, np.pi, 2):
                steps = np.arange(0.0, rng.uniform(4.0, 9.0), 0.15)
                walls.append(corner + steps[:, None] * [np.cos(angle), np.sin(angle)])
    return np.vstack(walls)


def drive(t):
    """Poses (K, 3) and body velocity (K, 2) [m/s], yaw rate (K,) at times (K,) [s].

    It winds ahead and drifts sideways, so that left is not right.
    """
    yaw = 0.5 * np.sin(0.35 * t) + 0.2 * np.sin(1.1 * t)
    rate = 0.5 * 0.35 * np.cos(0.35 * t) + 0.2 * 1.1 * np.cos(1.1 * t)
    body = np.column_stack([0.8 + 0.1 * np.sin(0.2 * t), 0.15 * np.cos(0.5 * t) + 0.05])
    return yaw, rate, body


def vehicle(seed, duration_s=60.0):
    """Navigation and pings of one vehicle."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s, 0.01)
    yaw, rate, body = drive(t)
    world = np.column_stack(
        [
            np.cos(yaw) * body[:, 0] - np.sin(yaw) * body[:, 1],
            np.sin(yaw) * body[:, 0] + np.cos(yaw) * body[:, 1],
        ]
    )
    xy = np.cumsum(world, axis=0) * 0.01
    points = place(rng)
    imu, dvl = slice(0, None, 5), slice(3, None, 16)
    lever = np.column_stack([-DVL_LEVER[1] * rate, DVL_LEVER[0] * rate])
    navigation = NavigationSample(
        t[imu],
        yaw[imu] + 1.0 + rng.normal(0.0, 0.003, len(t[imu])),
        rate[imu] + rng.normal(0.0, 0.002, len(t[imu])),
        t[dvl],
        (body + lever)[dvl] + rng.normal(0.0, 0.01, (len(t[dvl]), 2)),
        DVL_LEVER,
    )
    stamps, echoes = [], []
    for k in range(100, len(t) - 100, 100):
        T_world_sonar = SE2(*xy[k], yaw[k]) @ SONAR
        seen = T_world_sonar.inverse().apply(points)
        is_near = (np.hypot(*seen.T) < _RANGE_M) & (seen[:, 0] > 0.3 * np.abs(seen[:, 1]))
        echoes.append(seen[is_near] + rng.normal(0.0, 0.03, (int(is_near.sum()), 2)))
        stamps.append(t[k])
    return navigation, PingSample(np.array(stamps), tuple(echoes), SONAR)
