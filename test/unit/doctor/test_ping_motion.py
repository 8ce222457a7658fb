"""How a sonar moved by its echoes: as far as it did, whatever its fan cuts off."""

import numpy as np
import pytest

from uw_dslam_ros2.core.doctor import PingSample
from uw_dslam_ros2.core.doctor.motions.ping_motion import ping_motions

STEP_M = 0.8


def quays(rng):
    """Points (N, 2) of two walls along x, 0.1 m apart, with steps of 1 m here and there."""
    x = np.arange(0.0, 30.0, 0.1)
    sides = []
    for side in (-4.0, 4.0):
        is_step = np.zeros(len(x), bool)
        for begin in np.cumsum(rng.integers(15, 60, 20)):
            is_step[begin : begin + 10] = True
        sides.append(np.column_stack([x, side - np.sign(side) * 1.0 * is_step]))
    return np.vstack(sides)


def seen_from(walls, x, rng):
    points = walls - [x, 0.0] + rng.normal(0.0, 0.03, walls.shape)
    bearing, distance = np.arctan2(points[:, 1], points[:, 0]), np.hypot(*points.T)
    return points[(np.abs(bearing) < 1.0) & (distance < 9.0)]


@pytest.mark.parametrize("seed", [0, 1])
def test_walls_that_go_on_where_the_fan_ends_do_not_hold_it_back(seed):
    rng = np.random.default_rng(seed)
    walls, stamps = quays(rng), np.arange(10.0)
    pings = tuple(seen_from(walls, STEP_M * t, rng) for t in stamps)
    motions = ping_motions(PingSample(stamps, pings), 0.7, 2.1)
    assert len(motions) >= 8
    assert np.median(motions.motion[:, 0]) == pytest.approx(STEP_M, abs=0.02)
