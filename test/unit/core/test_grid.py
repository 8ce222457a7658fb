"""Metres to cells and back, by hand-written numbers."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap, bounds_of, strips_of
from uw_dslam_ros2.core.se2 import SE2


def test_cells_are_row_col_and_floor_of_metres():
    spec = GridSpec(0.5, num_rows=3, num_cols=4, T_frame_grid=SE2(-1.0, 2.0, 0.0))
    points = [[-0.9, 2.1], [0.9, 3.4], [-1.1, 1.9]]
    assert spec.cells_of(points).tolist() == [[0, 0], [2, 3], [-1, -1]]
    assert spec.contains(spec.cells_of(points)).tolist() == [True, True, False]


def test_centres_sit_half_a_cell_from_the_origin():
    spec = GridSpec(0.5, num_rows=3, num_cols=4, T_frame_grid=SE2(-1.0, 2.0, 0.0))
    np.testing.assert_allclose(spec.centers_of([[0, 0], [2, 3]]), [[-0.75, 2.25], [0.75, 3.25]])


def test_a_rotated_origin_turns_the_axes():
    spec = GridSpec(1.0, num_rows=2, num_cols=3, T_frame_grid=SE2(10.0, 0.0, math.pi / 2))
    # The grid's x axis points along the frame's y, its y axis along the frame's -x.
    np.testing.assert_allclose(spec.centers_of([[0, 2]]), [[9.5, 2.5]])
    assert spec.cells_of([[9.5, 2.5]]).tolist() == [[0, 2]]
    np.testing.assert_allclose(spec.corners()[1], [10.0, 3.0], atol=1e-12)


def test_cells_of_centres_are_the_cells():
    spec = GridSpec(0.05, 7, 11, SE2(123.4, -56.7, 0.3))
    cells = np.stack(np.meshgrid(range(7), range(11), indexing="ij"), axis=-1).reshape(-1, 2)
    assert (spec.cells_of(spec.centers_of(cells)) == cells).all()


@pytest.mark.parametrize("resolution", [0.0, -0.1, math.nan])
def test_a_resolution_that_is_not_positive_is_refused(resolution):
    with pytest.raises(InvalidInputError, match="resolution is"):
        GridSpec(resolution, 2, 2)


def test_a_grid_without_cells_is_refused():
    with pytest.raises(InvalidInputError, match="0 rows"):
        GridSpec(0.05, 0, 2)


def test_values_outside_the_scale_are_refused():
    with pytest.raises(InvalidInputError, match="hold 101"):
        OccupancyMap(GridSpec(1.0, 1, 2), np.array([[0, 101]], dtype=np.int8))


def test_an_occupancy_map_cannot_be_written_to():
    occupancy = OccupancyMap(GridSpec(1.0, 1, 2), np.array([[0, 100]], dtype=np.int8))
    with pytest.raises(ValueError, match="read-only"):
        occupancy.values[0, 0] = 3


@pytest.mark.parametrize("num_rows", [0, 1, 255, 256, 257, 1000])
@pytest.mark.parametrize("margin", [0, 7])
def test_strips_have_each_row_once_and_what_is_around_it(num_rows, margin):
    rows = np.arange(num_rows)
    strips = strips_of(num_rows, margin)
    assert np.concatenate([rows[:0], *(rows[s.rows] for s in strips)]).tolist() == rows.tolist()
    for strip in strips:
        around = rows[strip.around]
        assert around[strip.inside].tolist() == rows[strip.rows].tolist()
        assert around[0] == max(0, strip.rows.start - margin)
        assert around[-1] == min(num_rows, strip.rows.stop + margin) - 1


def test_bounds_hold_all_that_is_set_and_no_row_more():
    mask = np.zeros((9, 12), bool)
    assert bounds_of(mask) is None
    mask[3, 4] = mask[6, 2] = True
    assert bounds_of(mask) == (slice(3, 7), slice(2, 5))


def test_a_part_of_a_grid_has_its_cells_where_they_were():
    spec = GridSpec(0.2, 30, 40, SE2(5.0, -3.0, 0.7))
    part = spec.part(-4, 6, 8, 9)
    cells = np.argwhere(np.ones(part.shape))
    np.testing.assert_allclose(
        part.centers_of(cells), spec.centers_of(cells + np.array([-4, 6])), atol=1e-12
    )
