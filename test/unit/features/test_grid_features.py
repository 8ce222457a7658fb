"""Cleaning cells, wall points and ORB points of occupancy maps."""

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.grid_filter import clean_cells, clean_masks, coarsen
from uw_dslam_ros2.core.features.grid_points import POINT_METHODS, grid_points
from uw_dslam_ros2.core.features.walls import wall_points
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

pytestmark = pytest.mark.kernels


def _map(values: np.ndarray, resolution_m: float = 0.1, **kwargs: SE2) -> OccupancyMap:
    return OccupancyMap(GridSpec(resolution_m, *values.shape, **kwargs), values.astype(np.int8))


def _wall() -> np.ndarray:
    values = np.zeros((40, 60))
    values[20, 5:55] = 100
    return values


def test_lines_stay_and_specks_go():
    rng = np.random.default_rng(0)
    values = _wall()
    specks = rng.random(values.shape) < 0.02
    specks[14:27] = False
    values[specks] = 100
    cells = clean_cells(_map(values))
    assert cells.wall[20, 8:52].all()
    assert cells.wall[specks].mean() < 0.02  # none was seen
    assert cells.free[specks].mean() > 0.8


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.8, 1.3, 2.2])
def test_a_broken_line_stays_at_any_angle(angle):
    rng = np.random.default_rng(1)
    t = np.linspace(-25.0, 25.0, 200)
    cells = np.floor(np.column_stack([np.sin(angle) * t, np.cos(angle) * t]) + 40).astype(int)
    cells = np.unique(cells, axis=0)
    cells = cells[rng.random(len(cells)) > 0.35]
    values = np.zeros((80, 80))
    values[cells[:, 0], cells[:, 1]] = 100
    assert clean_cells(_map(values)).wall[cells[:, 0], cells[:, 1]].mean() > 0.85


def test_a_filled_body_is_reduced_to_its_surface():
    values = np.zeros((40, 40))
    values[10:30, 10:30] = 100
    cells = clean_cells(_map(values))
    assert cells.wall[10, 15] == 1.0
    assert cells.wall[20, 20] == 0.0
    assert cells.free[20, 20] == 0.0


def test_coarse_cells_keep_place_and_area():
    values = _wall()
    values[:, 50:] = -1
    cells = clean_cells(_map(values))
    coarse = coarsen(cells, 0.25)
    assert coarse.shape == (16, 24)
    rows, cols = np.nonzero(coarse.wall > 0.25)
    np.testing.assert_allclose(coarse.row[rows, cols] * 0.25, 20.5 * 0.1, atol=1e-6)
    assert coarse.free.sum() * 0.25**2 == pytest.approx(cells.free.sum() * 0.1**2, rel=0.05)


@pytest.mark.parametrize("ratio", [1.0, 1.7, 2.0, 3.0])
def test_masks_are_made_larger_as_shares_are(ratio):
    occupancy = _map(_wall())
    size_m = ratio * occupancy.spec.resolution_m
    by_masks, by_shares = (coarsen(f(occupancy), size_m) for f in (clean_masks, clean_cells))
    for name in ("wall", "free", "known", "row", "col"):
        found, expected = getattr(by_masks, name), getattr(by_shares, name)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, expected)


def test_cells_of_the_same_size_pass_unchanged():
    cells = clean_cells(_map(_wall()))
    assert coarsen(cells, 0.1) is cells


def test_wall_points_lie_on_the_wall_evenly():
    points, weights = wall_points(clean_cells(_map(_wall())), 20)
    assert 10 <= len(points) <= 20
    np.testing.assert_allclose(points[:, 1], 20.5)
    gaps = np.diff(np.sort(points[:, 0]))
    assert gaps.max() < 3.0 * gaps.mean()
    assert weights.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("method", POINT_METHODS)
def test_points_are_near_walls_and_move_with_the_frame(method):
    rng = np.random.default_rng(2)
    values = np.zeros((80, 80))
    for _ in range(6):
        row, col = rng.integers(10, 60, 2)
        values[row : row + 2, col : col + 15] = 100
        values[row : row + 12, col : col + 2] = 100
    pose = SE2(3.0, -2.0, 0.6)
    points, weights = grid_points(_map(values), method, 50)
    turned, _ = grid_points(_map(values, T_frame_grid=pose), method, 50)
    assert 0 < len(points) <= 50
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(turned, pose.apply(points))
    walls = (np.argwhere(values == 100)[:, ::-1] + 0.5) * 0.1
    nearest = np.linalg.norm(points[:, None] - walls, axis=2).min(axis=1)
    assert nearest.max() < 0.5


def test_orb_ignores_the_edge_of_the_known():
    values = np.full((80, 80), -1)
    values[10:70, 10:70] = 0
    values[40, 20:60] = 100
    values[30:50, 40] = 100
    points, _ = grid_points(_map(values), "orb", 50)
    assert len(points) > 0
    assert np.abs(points - 4.0).max() < 2.5


def test_an_unknown_map_has_no_points():
    points, weights = grid_points(_map(np.full((20, 20), -1)), "both", 50)
    assert points.shape == (0, 2)
    assert weights.shape == (0,)


def test_an_unknown_method_is_named():
    with pytest.raises(InvalidInputError, match="sift"):
        grid_points(_map(_wall()), "sift")


def test_whole_ratios_sum_as_any_other():
    rng = np.random.default_rng(4)
    values = rng.choice([-1, 0, 0, 0, 100], (37, 53))
    cells = clean_cells(_map(values))
    quick, plain = coarsen(cells, 0.3), coarsen(cells, 0.3 * (1.0 + 1e-7))
    for name in ("wall", "free", "known", "row", "col"):
        np.testing.assert_allclose(getattr(quick, name), getattr(plain, name), atol=1e-4)
