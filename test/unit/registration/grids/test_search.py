"""The certified search on signed fields, against dense evaluation of the same objective."""

import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids import kernels as grid_kernels
from uw_dslam_ros2.core.registration.grids import search as grid_search
from uw_dslam_ros2.core.registration.grids.landscape import scan_landscape
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow, build_problem
from uw_dslam_ros2.core.registration.grids.signed_field import (
    PAD,
    SignedField,
    curvature_tables,
    refined,
    signed_field,
    value_tables,
    wall_distance,
)


def _room(rng: np.random.Generator, size: int) -> OccupancyMap:
    """A small room with two random walls."""
    values = np.zeros((size, size), np.int8)
    values[2:4, 2:-2], values[-4:-2, 2:-2] = 100, 100
    values[2:-2, 2:4] = 100
    row, col = rng.integers(size // 3, 2 * size // 3, 2)
    values[row, col:-2], values[2:row, col] = 100, 100
    values[-8:, -8:] = -1
    return OccupancyMap(GridSpec(0.1, size, size), values)


def _problem(seed: int, size: int = 40) -> GridProblem:
    rng = np.random.default_rng(seed)
    maps = [clean_cells(_room(rng, size)) for _ in range(2)]
    return build_problem(
        maps[0], maps[1], stride=2, sigma_cells=1.0, free_penalty=0.7, max_points=60
    )


@pytest.fixture(scope="module")
def problem() -> GridProblem:
    return _problem(1)


def _search(problem: GridProblem, window: PoseWindow, gap: float) -> grid_search.SearchOutcome:
    limits = grid_search.SearchLimits(gap, 3_000_000)
    return grid_search.search_poses(problem, window, window.middle, limits)


@pytest.mark.parametrize("seed", [1, 2])
def test_certificate_holds_against_dense_evaluation(seed):
    problem = _problem(seed)
    window = PoseWindow(np.array([0.3, 10.0, 10.0]), np.array([1.5, 8.0, 8.0]))
    outcome = _search(problem, window, 0.02)
    thetas = np.arange(-1.2, 1.8, 0.06)
    axes = [np.arange(m - h, m + h, 0.5) for m, h in zip(window.middle, window.half, strict=True)]
    poses = np.stack(np.meshgrid(thetas, *axes[1:], indexing="ij"), axis=-1).reshape(-1, 3)
    dense = float(grid_kernels.objective_at(poses, *problem.arguments).max())
    assert outcome.is_complete
    assert outcome.lower_bound <= outcome.upper_bound
    assert dense <= outcome.upper_bound + 1e-9
    assert outcome.lower_bound >= (1.0 - 0.02) * dense - 1e-9
    assert outcome.upper_bound <= outcome.lower_bound / (1.0 - 0.02) + 1e-9
    assert outcome.lower_bound == pytest.approx(problem.value(outcome.pose), abs=1e-9)


@pytest.mark.parametrize("half", [8.0, 3.0, 1.0, 0.5, 0.2, 0.05])
def test_no_pose_of_a_box_exceeds_its_bound(problem, half):
    rng = np.random.default_rng(3)
    search = grid_search._Search(problem, np.zeros(3), grid_search.SearchLimits(0.1, 1), None)
    boxes = np.column_stack([rng.uniform(-3, 3, 40), rng.uniform(-5, 25, (40, 2))])
    half_rad = half / problem.radius
    for arguments in (search._coarse, search._fine):
        for is_smooth in (False, True):
            bounds, _ = grid_kernels.bound_boxes(
                boxes, np.full(40, np.inf), half_rad, half, -np.inf, is_smooth, False, *arguments
            )
            for box, bound in zip(boxes, bounds, strict=True):
                offsets = rng.uniform(-1, 1, (60, 3)) * (half_rad, half, half)
                values = grid_kernels.objective_at(box + offsets, *problem.arguments)
                assert values.max() <= bound + 1e-9


def test_small_boxes_close_quadratically(problem):
    pose, _ = problem.ascend(scan_landscape(problem, 1).poses[0])
    search = grid_search._Search(problem, pose, grid_search.SearchLimits(0.1, 1), None)
    slack = []
    for half in (0.1, 0.05):
        bounds, _ = grid_kernels.bound_boxes(
            pose[None, :], np.full(1, np.inf), half / problem.radius, half, -np.inf, True, False,
            *search._fine,
        )  # fmt: skip
        slack.append(bounds[0] - problem.value(pose))
    assert slack[1] < 0.35 * slack[0]


def test_tables_bound_the_field_and_its_refinement_is_the_same_function():
    rng = np.random.default_rng(5)
    field = SignedField(np.pad(rng.uniform(-0.7, 1.0, (12, 15)), PAD).astype(np.float32))
    points = rng.uniform(-2.0, 14.0, (300, 2))
    weights, none = np.ones(1), np.empty((0, 2))
    values = value_tables(field) * grid_kernels.TABLE_STEP
    bends = curvature_tables(field) * grid_kernels.CURVATURE_STEP
    fine = refined(field).coefficients
    for point in points:
        row, col = np.floor(point[::-1] + PAD + 0.5).astype(int)

        def value(at: np.ndarray, coefficients: np.ndarray, pad: float) -> float:
            return grid_kernels.objective(
                np.zeros(3), at[None, :], weights, coefficients,
                none, np.empty(0), coefficients, np.zeros(2), pad,
            )[0]  # fmt: skip

        here = value(point, field.coefficients, float(PAD))
        assert here <= values[0, row, col] + 1e-9
        assert here == pytest.approx(value(2.0 * point + 0.5, fine, 2.0 * PAD), abs=1e-6)
        step = np.array([0.03, 0.0])
        around = value(point + step, field.coefficients, float(PAD)) + value(
            point - step, field.coefficients, float(PAD)
        )
        window = bends[2, row - 1, col - 1]  # three cells wide, the point's in the middle
        assert (around - 2.0 * here) / 0.03**2 <= window + 1e-6


def test_gradient_is_that_of_the_objective(problem):
    rng = np.random.default_rng(7)
    for _ in range(20):
        pose = np.array([rng.uniform(-3, 3), *rng.uniform(0, 20, 2)])
        _, *gradient = grid_kernels.objective(pose, *problem.arguments)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-5
            ahead, behind = problem.value(pose + step), problem.value(pose - step)
            assert gradient[axis] == pytest.approx((ahead - behind) / 2e-5, abs=1e-4)


def test_poses_and_motions_undo_each_other(problem):
    pose = np.array([0.7, 3.0, -2.0])
    motion = problem.to_motion(pose)
    np.testing.assert_allclose(problem.to_pose(motion), pose, atol=1e-12)
    cells = problem.source_points + problem.center
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    expected = problem.source_points @ turn.T + pose[1:]
    moved = motion.apply((cells + 0.5) * problem.resolution_m) / problem.resolution_m - 0.5
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_landscape_peaks_are_the_objective_there(problem):
    landscape = scan_landscape(problem, 10)
    values = grid_kernels.objective_at(landscape.poses, *problem.arguments)
    # The scan spreads points over four cells and interpolates the turned field.
    np.testing.assert_allclose(landscape.scores, values, atol=0.12)
    assert (np.diff(landscape.scores) <= 0).all()


def test_a_short_budget_still_gives_true_bounds(problem):
    window = grid_search.whole_plane(problem)
    full = _search(problem, window, 0.02)
    limits = grid_search.SearchLimits(0.02, 1000)
    short = grid_search.search_poses(problem, window, window.middle, limits)
    assert not short.is_complete
    assert short.upper_bound >= full.lower_bound
    assert short.lower_bound <= full.upper_bound


def test_a_stopped_search_says_so(problem):
    window = grid_search.whole_plane(problem)
    limits = grid_search.SearchLimits(0.02, 3_000_000, lambda: True)
    outcome = grid_search.search_poses(problem, window, window.middle, limits)
    assert outcome.is_stopped
    assert not outcome.is_complete


@pytest.mark.parametrize("stride", [1, 3])
def test_the_field_is_the_mean_of_its_definition_over_blocks(stride):
    cells = clean_cells(_room(np.random.default_rng(6), 41))
    distance = wall_distance(cells).astype(float)
    near = np.exp(-0.5 * (distance / (1.5 * stride)) ** 2)
    padded = np.pad(cells.free, 2)
    free = np.mean([padded[r : r + 41, c : c + 41] for r in range(5) for c in range(5)], axis=0)
    plain = near - 0.7 * free * (1.0 - near)
    side = -(-41 // stride)
    plain = np.pad(plain, (0, side * stride - 41))
    expected = plain.reshape(side, stride, side, stride).mean(axis=(1, 3))
    found = signed_field(cells, 1.5 * stride, 0.7, stride).coefficients
    np.testing.assert_allclose(found, np.pad(expected, PAD), atol=1e-5)


def test_distances_to_walls_are_exact_to_the_last_bit():
    cells = clean_cells(_room(np.random.default_rng(6), 97))
    walls = np.argwhere(cells.wall > 0.25)
    index = np.stack(np.meshgrid(*2 * [np.arange(97)], indexing="ij"), axis=-1)
    square = ((index[:, :, None, :] - walls) ** 2).sum(axis=-1).min(axis=-1)
    np.testing.assert_array_equal(wall_distance(cells), np.sqrt(square.astype(np.float32)))


def test_a_stopped_search_tells_where_it_did_not_look(problem):
    window = PoseWindow(np.array([0.3, 10.0, 10.0]), np.array([1.5, 8.0, 8.0]))
    stopped = grid_search.search_poses(
        problem, window, window.middle, grid_search.SearchLimits(0.02, 1000)
    )
    assert not stopped.is_complete
    assert 0 < len(stopped.open_poses) <= 64
    offset = np.abs(stopped.open_poses - window.middle)
    assert (offset <= window.half + 1e-9).all()
    assert len(_search(problem, window, 0.05).open_poses) == 0


def test_many_climbs_end_where_each_alone_does(problem):
    rng = np.random.default_rng(8)
    starts = np.column_stack([rng.uniform(-3.0, 3.0, 20), rng.uniform(0.0, 20.0, (20, 2))])
    poses, values = problem.ascend_all(starts)
    for start, pose, value in zip(starts, poses, values, strict=True):
        alone, best = problem.ascend(start)
        np.testing.assert_array_equal(alone, pose)
        assert best == value
        assert value >= problem.value(start)


def test_swept_boxes_get_the_second_bound_or_keep_theirs(problem):
    pose, _ = problem.ascend(scan_landscape(problem, 1).poses[0])
    search = grid_search._Search(problem, pose, grid_search.SearchLimits(0.1, 1), None)
    boxes, half_rad = pose + np.array([[0.0, 0.0, 0.0], [0.02, 0.3, -0.2]]), 0.1 / problem.radius
    bounds = [
        grid_kernels.bound_boxes(
            boxes, np.full(2, parent), half_rad, 0.1, -np.inf, True, is_swept, *search._fine
        )[0]
        for parent, is_swept in ((np.inf, True), (np.inf, False), (0.01, True))
    ]
    assert (bounds[0] >= bounds[1]).all()
    assert (bounds[0] >= grid_kernels.objective_at(boxes, *problem.arguments)).all()
    np.testing.assert_array_equal(bounds[2], 0.01)
