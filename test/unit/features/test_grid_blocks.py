"""Enlarged maps are brought back to the cells that they were made of."""

import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_blocks import shrink_blocks
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

POSE = SE2(3.0, -2.0, 0.6)


def _random(rng, shape=(60, 70)) -> np.ndarray:
    return rng.choice([-1, 0, 0, 100], shape).astype(np.int8)


def _enlarged(values: np.ndarray, side: int) -> np.ndarray:
    return np.repeat(np.repeat(values, side, axis=0), side, axis=1)


def _map(values: np.ndarray, resolution_m: float) -> OccupancyMap:
    return OccupancyMap(GridSpec(resolution_m, *values.shape, POSE), values)


@pytest.mark.parametrize("side", [2, 3, 4, 8])
@pytest.mark.parametrize("cut", [(0, 0), (1, 2)])
def test_every_cell_of_an_enlarged_map_keeps_its_value_and_place(rng, side, cut):
    large = _map(_enlarged(_random(rng), side)[cut[0] :, cut[1] :].copy(), 0.05)
    small = shrink_blocks(large)
    assert small.spec.resolution_m == pytest.approx(0.05 * side)
    cells = np.argwhere(np.ones(large.spec.shape))
    found = small.spec.cells_of(large.spec.centers_of(cells))
    np.testing.assert_array_equal(small.values[found[:, 0], found[:, 1]], large.values.ravel())


def test_some_noise_after_the_enlarging_does_no_harm(rng):
    values = _random(rng)
    large = _enlarged(values, 4)
    noise = rng.random(large.shape) < 0.004
    large[noise] = 100
    small = shrink_blocks(_map(large, 0.05))
    assert small.spec.shape == values.shape
    assert (small.values == values).mean() > 0.99


def test_other_maps_pass_unchanged(rng):
    room = np.full((160, 220), -1, np.int8)
    room[20:140, 20:200], room[24:136, 24:196] = 100, 0
    for values in (_random(rng), _random(rng, (300, 200)), room, np.zeros((200, 200), np.int8)):
        occupancy = _map(values, 0.05)
        assert shrink_blocks(occupancy) is occupancy
