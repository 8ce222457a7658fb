"""The scan of all rotations in stacks, against plain sums for one pose after the other."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.grids.finding import landscape as grid_landscape
from uw_dslam_ros2.core.registration.grids.finding import landscape_kernels
from uw_dslam_ros2.core.registration.grids.finding.landscape import distinct, scan_landscape
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import PAD, padded_field
from uw_dslam_ros2.core.registration.search.field import Field

pytestmark = pytest.mark.kernels

_SHAPES = [((12, 17), (14, 11)), ((3, 30), (9, 9)), ((10, 10), (2, 21))]


def _problem(source: tuple[int, int], target: tuple[int, int]) -> GridProblem:
    """Fields and points at random; the source's centre is near a corner."""
    rng = np.random.default_rng(4)
    sides = []
    for rows, cols in (source, target):
        field = np.pad(rng.uniform(-0.7, 1.0, (rows, cols)), PAD).astype(np.float32)
        points = rng.uniform(-0.5, np.array([cols, rows]) - 0.5, (25, 2))
        # Points on the very edge of a map must find room, too.
        points[:4] = [[-0.5, -0.5], [cols - 0.5, -0.5], [-0.5, rows - 0.5], [cols - 0.5] * 2]
        points[3, 1] = rows - 0.5
        sides.append((points, padded_field(field)))
    weights = rng.uniform(0.0, 1.0, (2, 25)) ** 2
    weights *= 0.5 / weights.sum(axis=1, keepdims=True)
    (source_points, source_field), (target_points, target_field) = sides
    center = np.array([1.3, 0.4])
    return GridProblem(
        1.0, source_points - center, weights[0], source_field,
        target_points, weights[1], target_field, center,
    )  # fmt: skip


def _bilinear(field: Field, points: np.ndarray) -> np.ndarray:
    """Field between its cells, zero outside, at points (..., 2)."""
    rim = 90
    image = np.pad(field.coefficients.astype(float), rim)
    cell = np.floor(points).astype(int)
    fx, fy = np.moveaxis(points - cell, -1, 0)
    col, row = np.moveaxis(cell + rim + PAD, -1, 0)
    above = (1.0 - fx) * image[row, col] + fx * image[row, col + 1]
    below = (1.0 - fx) * image[row + 1, col] + fx * image[row + 1, col + 1]
    return (1.0 - fy) * above + fy * below


def _scores(problem: GridProblem, theta: float, lags: np.ndarray) -> np.ndarray:
    """What the scan is to find at lags [t_x, t_y] (K, 2), point by point."""
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    turned = problem.source_points @ turn.T + lags[:, None, :]
    scores = _bilinear(problem.target_field, turned) @ problem.source_weights
    corner = np.floor(problem.target_points)
    part = problem.target_points - corner
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
        back = (corner + np.array([x, y]) - lags[:, None, :]) @ turn + problem.center
        scores += _bilinear(problem.source_field, back) @ (problem.target_weights * share)
    return scores


@pytest.mark.parametrize("shapes", _SHAPES)
def test_the_greatest_of_a_rotation_is_that_of_all_its_translations(shapes):
    problem = _problem(*shapes)
    lags = np.stack(np.meshgrid(*2 * [np.arange(-45, 55)]), axis=-1).reshape(-1, 2)
    thetas = np.array([-3.1, -1.7, -0.4, 0.0, 0.5 * math.pi, 2.0])
    _, greatest = grid_landscape._Scan(problem).best(thetas, None)
    np.testing.assert_array_equal(greatest[:, 0], thetas)
    for theta, (_, *lag, score) in zip(thetas, greatest, strict=True):
        expected = _scores(problem, theta, lags)
        assert score == pytest.approx(expected.max(), abs=1e-5)
        assert _scores(problem, theta, np.array([lag]))[0] == pytest.approx(score, abs=1e-5)


@pytest.mark.parametrize(("half_y", "num_peaks"), [(5.0, 4), (1.0, 2)])
def test_peaks_of_a_window_are_the_best_in_it_and_apart(half_y, num_peaks):
    problem = _problem(*_SHAPES[0])
    window = PoseWindow(np.array([0.3, 4.0, 5.0]), np.array([0.5, 3.5, half_y]))
    theta = 0.2
    peaks, _ = grid_landscape._Scan(problem).best(np.array([theta]), window)
    rows = np.arange(5 - int(half_y) - 1, 5 + int(half_y) + 2)
    lags = np.stack(np.meshgrid(np.arange(0, 9), rows), axis=-1)
    scores = _scores(problem, theta, lags.reshape(-1, 2)).reshape(len(rows), 9)
    assert np.isneginf(peaks[0, num_peaks:, 3]).all()  # for those there is no room
    for _, t_x, t_y, score in peaks[0, :num_peaks]:
        row, col = np.unravel_index(scores.argmax(), scores.shape)
        assert score == pytest.approx(scores[row, col], abs=1e-5)
        np.testing.assert_array_equal([t_x, t_y], lags[row, col])
        scores[max(row - 3, 0) : row + 4, max(col - 3, 0) : col + 4] = -np.inf


def test_a_stack_of_rotations_is_one_after_the_other():
    problem = _problem(*_SHAPES[1])
    scan = grid_landscape._Scan(problem)
    thetas = np.linspace(-3.0, 3.0, 2 * len(scan._stack) + 1)
    peaks, greatest = scan.best(thetas, None)
    for k, theta in enumerate(thetas):
        alone, best = grid_landscape._Scan(problem).best(np.array([theta]), None)
        np.testing.assert_array_equal(alone[0, :, :3], peaks[k, :, :3])
        np.testing.assert_allclose(alone[0, :, 3], peaks[k, :, 3], atol=1e-6)
        np.testing.assert_allclose(best[0], greatest[k], atol=1e-6)


@pytest.mark.parametrize("half_rad", [math.pi, 0.4])
def test_the_window_decides_on_peaks_but_not_on_chance(half_rad):
    problem = _problem(*_SHAPES[0])
    whole = scan_landscape(problem, 10)
    window = PoseWindow(np.array([0.5, 4.0, 4.0]), np.array([half_rad, 2.0, 3.0]))
    narrow = scan_landscape(problem, 10, window)
    offset = np.abs(narrow.poses - window.middle)
    offset[:, 0] = np.abs((offset[:, 0] + math.pi) % (2.0 * math.pi) - math.pi)
    assert 0 < len(narrow.poses) <= 10
    assert (offset <= window.half + np.array([1e-9, 1.0, 1.0])).all()
    np.testing.assert_allclose(narrow.background_poses, whole.background_poses)
    np.testing.assert_allclose(narrow.background_scores, whole.background_scores, atol=1e-6)


def test_threads_at_once_find_the_same_to_the_last_bit():
    problems = [_problem(*_SHAPES[k % 3]) for k in range(6)]
    alone = [scan_landscape(problem, 24) for problem in problems]
    with ThreadPoolExecutor(3) as pool:
        at_once = list(pool.map(lambda problem: scan_landscape(problem, 24), problems))
    for one, other in zip(alone, at_once, strict=True):
        np.testing.assert_array_equal(one.poses, other.poses)
        np.testing.assert_array_equal(one.scores, other.scores)
        np.testing.assert_array_equal(one.background_scores, other.background_scores)


def test_a_turned_map_is_drawn_whole_and_nothing_else_is_touched():
    problem = _problem(*_SHAPES[1])
    scan = grid_landscape._Scan(problem)
    side = 2 * scan._half + 1
    thetas = np.linspace(-3.2, 3.2, 90)
    places = scan._places(thetas)
    stack = np.full((90, 2, side + 2, side + 3), 7.0, np.float32)
    landscape_kernels.draw_turned(
        thetas, places, problem.source_points, problem.source_weights,
        problem.source_field.coefficients, PAD, problem.center, side, stack,
    )  # fmt: skip
    assert (stack[:, :, side:] == 7.0).all()
    assert (stack[:, :, :, side:] == 7.0).all()
    np.testing.assert_allclose(stack[:, 0, :side, :side].sum(axis=(1, 2)), 0.5, rtol=1e-5)
    pixels = np.stack(np.meshgrid(*2 * [np.arange(side)]), axis=-1).reshape(-1, 2)
    for k, theta in enumerate(thetas):
        cos, sin = math.cos(theta), math.sin(theta)
        at = (pixels - places[k]) @ np.array([[cos, -sin], [sin, cos]]) + problem.center
        expected = _bilinear(problem.source_field, at).reshape(side, side)
        np.testing.assert_allclose(stack[k, 1, :side, :side], expected, atol=1e-4)
        # The square is as large as needed: what lies outside is zero.
        beyond = np.array([[-1, c] for c in range(-1, side)] + [[side, c] for c in range(side)])
        for edge in (beyond, beyond[:, ::-1]):
            back = (edge - places[k]) @ np.array([[cos, -sin], [sin, cos]]) + problem.center
            assert not _bilinear(problem.source_field, back).any()


def test_points_spread_over_four_cells_keep_weight_and_place():
    rng = np.random.default_rng(5)
    points, weights = rng.uniform(-8.0, 8.0, (200, 2)), rng.uniform(0.1, 1.0, 200)
    image = np.zeros((26, 26), np.float32)
    landscape_kernels.splat(image, points, weights, 0.8, 0.6, 12.3, 11.4)
    assert image.sum() == pytest.approx(weights.sum(), rel=1e-4)
    index = np.arange(26)
    place = [(image.sum(axis=0) * index).sum(), (image.sum(axis=1) * index).sum()]
    turned = points @ np.array([[0.8, 0.6], [-0.6, 0.8]]) + (12.3, 11.4)
    np.testing.assert_allclose(place, weights @ turned, rtol=1e-4)


def test_distinct_poses_differ_in_place_or_in_turn_from_all_before():
    rng = np.random.default_rng(6)
    poses = np.column_stack([rng.uniform(-4.0, 4.0, 300), rng.uniform(0.0, 9.0, (300, 2))])
    kept: list[int] = []
    for index, pose in enumerate(poses):
        turn = np.abs((poses[kept, 0] - pose[0] + math.pi) % (2.0 * math.pi) - math.pi)
        shift = np.hypot(*(poses[kept, 1:] - pose[1:]).T)
        if not ((5.0 * turn < 2.0) & (shift < 2.0)).any():
            kept.append(index)
    assert distinct(poses, 5.0, 2.0, 300) == kept
    assert distinct(poses, 5.0, 2.0, 7) == kept[:7]
    assert distinct(np.empty((0, 3)), 5.0, 2.0, 7) == []
