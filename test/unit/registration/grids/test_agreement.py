"""What two maps say about each other at a pose, against the same in whole arrays."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.registration.grids.judging import agreement_kernels
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap, measure_agreement
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import make_pair

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def sides() -> tuple[WallMap, WallMap]:
    pair = make_pair("harbour", 0.7, "noisy", 4, size_cells=120)
    return WallMap(clean_cells(pair.source)), WallMap(clean_cells(pair.target))


def _counts(walls: WallMap, other: WallMap, T_other: SE2) -> tuple[int, int, int, float]:
    """Walls seen by the other map, near its walls, on its free space; sum of squared distances."""
    cells = np.floor(T_other.apply(walls.points)[:, ::-1]).astype(int)
    inside = (cells >= 0).all(axis=1) & (cells < other.seen.shape).all(axis=1)
    row, col = cells[inside].T
    known = other.cells.known[row, col] > 0.5
    distance, free = other.distance[row, col][known], other.free[row, col][known]
    near = distance <= 2.5
    conflict = (distance > 3.5) & (free > 0.6)
    return (
        int(known.sum()),
        int(near.sum()),
        int(conflict.sum()),
        float((distance[near] ** 2).sum()),
    )


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("shift", [(0.2, -0.3), (40.1, 9.7), (-300.0, 20.0)])
def test_agreement_is_that_of_both_directions(sides, yaw, shift):
    source, target = sides
    T_cells = SE2(*shift, yaw)
    there = _counts(source, target, T_cells)
    back = _counts(target, source, T_cells.inverse())
    seen, near, conflict, square = (a + b for a, b in zip(there, back, strict=True))
    found = measure_agreement(source, target, T_cells)
    assert found.num_walls == seen
    assert found.agreement == near / max(seen, 1)
    assert found.conflict == conflict / max(seen, 1)
    assert found.residual_cells == pytest.approx(math.sqrt(square / max(near, 1)))
    assert found.inlier_ratio == there[1] / len(source.points)
    assert found.target_inlier_ratio == back[1] / len(target.points)


def test_common_cells_are_those_known_to_both():
    rng = np.random.default_rng(3)
    first, second = rng.integers(0, 3, (2, 17, 31)).astype(np.uint8)
    both = (first > 0) & (second > 0)
    near = (both & (first == 2)).sum() + (both & (second == 2)).sum()
    assert agreement_kernels.count_common(first, second) == (both.sum(), near)


def test_a_map_shares_with_itself_all_that_it_knows(sides):
    source, _ = sides
    same = measure_agreement(source, source, SE2())
    assert same.overlap == 1.0
    assert same.wall_share == (source.seen == 2).sum() / source.num_known
    assert source.num_known == (source.cells.known > 0.5).sum()
