"""The certified search on signed fields, against dense evaluation of the same objective."""

import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.finding.landscape import scan_landscape
from uw_dslam_ros2.core.registration.grids.finding.search import search_poses, whole_plane
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow, build_problem
from uw_dslam_ros2.core.registration.grids.signed_field import PAD, signed_field, wall_distance
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.outcome import SearchOutcome, SearchSettings, Status
from uw_dslam_ros2.core.registration.search.problem import Problem

pytestmark = pytest.mark.kernels


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


def _search(problem: GridProblem, window: PoseWindow, gap: float) -> SearchOutcome:
    return search_poses(problem, window, window.middle, SearchSettings(gap, 3_000_000))


def _values(problem: GridProblem, poses: np.ndarray) -> np.ndarray:
    return np.array([problem.value(pose) for pose in poses])


@pytest.mark.parametrize("seed", [1, 2])
def test_certificate_holds_against_dense_evaluation(seed):
    problem = _problem(seed)
    window = PoseWindow(np.array([0.3, 10.0, 10.0]), np.array([1.5, 8.0, 8.0]))
    outcome = _search(problem, window, 0.02)
    thetas = np.arange(-1.2, 1.8, 0.06)
    axes = [np.arange(m - h, m + h, 0.5) for m, h in zip(window.middle, window.half, strict=True)]
    poses = np.stack(np.meshgrid(thetas, *axes[1:], indexing="ij"), axis=-1).reshape(-1, 3)
    dense = float(_values(problem, poses).max())
    assert outcome.is_complete
    assert outcome.lower_bound <= outcome.upper_bound
    assert dense <= outcome.upper_bound + 1e-9
    assert outcome.lower_bound >= (1.0 - 0.02) * dense - 1e-9
    assert outcome.upper_bound <= outcome.lower_bound / (1.0 - 0.02) + 1e-9
    # Refined, the fields are rounded once more.
    assert outcome.lower_bound == pytest.approx(problem.value(outcome.pose), abs=1e-7)


def _bounds(problem: Problem, box: np.ndarray) -> tuple[float, float]:
    """Bound by the greatest value that each point can reach, and that by curvature."""
    cells, out = np.empty((4, problem.points.shape[1]), np.int32), np.empty(5)
    first = kernels.bound_first(problem.sum, problem.bounds.windows, box, -np.inf, cells)
    room = np.empty((14, problem.points.shape[1]))
    kernels.bound_second(problem.sum, problem.bounds.curvatures, box, out, cells, room)
    return first, float(out[0])


@pytest.mark.parametrize("half", [8.0, 3.0, 1.0, 0.5, 0.2, 0.05])
@pytest.mark.parametrize("num_refinements", [0, 1, 2])
def test_no_pose_of_a_box_exceeds_its_bound(problem, half, num_refinements):
    rng = np.random.default_rng(3)
    searched = Problem(problem.terms(num_refinements), np.zeros(2), np.zeros(2))
    boxes = np.column_stack([rng.uniform(-3, 3, 40), rng.uniform(-5, 25, (40, 2))])
    halves = np.array([half / problem.radius, half, half])
    for box in boxes:
        bounds = _bounds(searched, np.concatenate([box, halves]))
        values = _values(problem, box + rng.uniform(-1, 1, (60, 3)) * halves)
        assert values.max() <= min(bounds) + 1e-7


def test_small_boxes_close_quadratically(problem):
    pose, _ = problem.ascend(scan_landscape(problem, 1).poses[0])
    searched = Problem(problem.terms(2), np.zeros(2), np.zeros(2))
    slack = []
    for half in (0.1, 0.05):
        box = np.array([*pose, half / problem.radius, half, half])
        slack.append(_bounds(searched, box)[1] - problem.value(pose))
    assert slack[1] < 0.35 * slack[0]


def test_gradient_is_that_of_the_objective(problem):
    rng = np.random.default_rng(7)
    for _ in range(20):
        pose = np.array([rng.uniform(-3, 3), *rng.uniform(0, 20, 2)])
        gradient = problem.gradient(pose)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-5
            ahead, behind = problem.value(pose + step), problem.value(pose - step)
            assert gradient[axis] == pytest.approx((ahead - behind) / 2e-5, abs=1e-4)


def test_poses_and_motions_undo_each_other(problem):
    pose = np.array([0.7, 3.0, -2.0])
    motion = problem.motion_of(pose)
    np.testing.assert_allclose(problem.pose_of(motion), pose, atol=1e-12)
    cells = problem.source_points + problem.center
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    expected = problem.source_points @ turn.T + pose[1:]
    moved = motion.apply((cells + 0.5) * problem.resolution_m) / problem.resolution_m - 0.5
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_landscape_peaks_are_the_objective_there(problem):
    landscape = scan_landscape(problem, 10)
    values = _values(problem, landscape.poses)
    # The scan spreads points over four cells and interpolates the turned field.
    np.testing.assert_allclose(landscape.scores, values, atol=0.12)
    assert (np.diff(landscape.scores) <= 0).all()


def test_a_short_budget_still_gives_true_bounds(problem):
    window = whole_plane(problem)
    full = _search(problem, window, 0.02)
    short = search_poses(problem, window, window.middle, SearchSettings(0.02, 100))
    assert not short.is_complete
    assert short.upper_bound >= full.lower_bound
    assert short.lower_bound <= full.upper_bound


def test_a_stopped_search_says_so(problem):
    window = whole_plane(problem)
    outcome = search_poses(
        problem, window, window.middle, SearchSettings(0.02), is_cancelled=lambda: True
    )
    assert outcome.status is Status.CANCELLED
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
    stopped = search_poses(problem, window, window.middle, SearchSettings(0.02, 100))
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
