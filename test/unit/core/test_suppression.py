"""Non-maximum suppression against trying every pair."""

import numpy as np
import pytest

from uw_dslam_ros2.core.suppression import first_apart


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("limit", [None, 0, 1, 4, 100])
def test_kept_are_apart_and_all_others_near_to_a_better_one(seed, limit):
    points = np.random.default_rng(seed).uniform(0.0, 10.0, size=(60, 2))
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 2.0
    kept = first_apart(len(points), lambda k: near[k], limit)
    every = first_apart(len(points), lambda k: near[k])
    assert kept == every[:limit]
    for index in range(len(points)):
        better = [k for k in every if k < index]
        assert (index in every) == (not near[index, better].any())


def test_of_nothing_nothing_is_kept():
    assert first_apart(0, lambda _: np.zeros(0, dtype=bool)) == []
