"""Poses that differ in rounding errors only are drawn alike."""

import numpy as np
import pytest

from uw_dslam_ros2.core.merging.drawn.global_map import snap_pose
from uw_dslam_ros2.core.se2 import SE2


@pytest.mark.parametrize("seed", range(20))
def test_snapping_moves_no_point_by_more_than_a_tenth_of_a_cell_each_way(seed):
    rng = np.random.default_rng(seed)
    radius_m, resolution_m = rng.uniform(1.0, 80.0), rng.uniform(0.02, 2.0)
    motion = SE2.from_array(rng.uniform(-200, 200, 3))
    snapped = snap_pose(motion, resolution_m, radius_m)
    rim = radius_m * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=-1)
    moved = np.hypot(*(snapped.apply(rim) - motion.apply(rim)).T)
    assert moved.max() <= 0.13 * resolution_m
    assert snap_pose(snapped, resolution_m, radius_m).distance_to(snapped) == pytest.approx((0, 0))
