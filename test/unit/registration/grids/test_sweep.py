"""Sweeps over two maps: every box's bound holds, and nothing above the threshold is left out."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.grids import kernels as grid_kernels
from uw_dslam_ros2.core.registration.grids import search as grid_search
from uw_dslam_ros2.core.registration.grids import sweep as grid_sweep
from uw_dslam_ros2.core.registration.grids import sweep_kernels as grid_sweep_kernels
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import (
    PAD,
    SignedField,
    refined,
    value_tables,
)
from uw_dslam_ros2.core.registration.grids.sweep import GridSweep, Tables
from uw_dslam_ros2.core.registration.grids.sweep_kernels import SIDE

KINDS = ["noise", "walls", "one point", "far points", "two sizes", "harsh"]


def _field(rng: np.random.Generator, shape: tuple[int, int], kind: str) -> SignedField:
    values = rng.uniform(-0.7, 1.0, shape)
    if kind == "walls":
        values = np.where(rng.random(shape) < 0.1, 1.0, -0.5)
    if kind == "harsh":
        values = np.where(rng.random(shape) < 0.5, 1.0, -2.0)
    return SignedField(np.pad(values, PAD).astype(np.float32))


def _problem(kind: str, seed: int = 1) -> GridProblem:
    """A small problem; the source's center is off the middle."""
    rng = np.random.default_rng(seed)
    sizes = {"two sizes": ((9, 30), (24, 14))}.get(kind, ((18, 16), (15, 20)))
    sides = []
    for rows, cols in sizes:
        count = 1 if kind == "one point" else 25
        points, weights = rng.uniform(0.0, 1.0, (count, 2)) * (cols, rows), rng.random(count)
        if kind == "far points":
            points[:2] *= 8.0
        sides.append((points, 0.5 * weights / weights.sum(), _field(rng, (rows, cols), kind)))
    source, target = sides
    center = source[0].mean(axis=0)
    return GridProblem(0.1, source[0] - center, *source[1:], *target, center)


def _tables(problem: GridProblem) -> list[Tables]:
    tables = []
    sides = [problem.target_field, problem.source_field]
    for scale in (1, 2):
        tables.append(Tables(scale, *(value_tables(side) for side in sides)))
        sides = [refined(side) for side in sides]
    return tables


def _window(half_rad: float = math.pi) -> PoseWindow:
    return PoseWindow(np.array([0.4, 9.3, 7.1]), np.array([half_rad, 21.0, 17.5]))


@pytest.fixture
def at_any_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sweep even where single boxes are cheaper."""
    monkeypatch.setattr(grid_sweep, "_LEVEL_COST", 0.0)
    monkeypatch.setattr(grid_sweep, "_ENTRY_COST", 0.0)
    monkeypatch.setattr(grid_sweep, "_TILE_COST", 1e-9)


def _advance(sweep: GridSweep, threshold: float) -> bool:
    return sweep.advance(threshold, 10**6, lambda: False)


def _some_boxes(
    sweep: GridSweep, threshold: float, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random boxes, their bounds, and their half-widths."""
    boxes, bounds = sweep.boxes(threshold)
    chosen = np.random.default_rng(2).choice(len(boxes), min(count, len(boxes)), replace=False)
    chosen[: count // 2] = np.arange(len(chosen[: count // 2]))  # and the most promising ones
    half = np.array([sweep.half_rad, sweep.half, sweep.half])
    return boxes[chosen], bounds[chosen], half


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("half_rad", [math.pi, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_no_pose_of_a_box_exceeds_its_bound(kind, half_rad):
    problem, rng = _problem(kind), np.random.default_rng(3)
    sweep, threshold = GridSweep(problem, _window(half_rad), _tables(problem)), -0.05
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    num_levels = 0
    while _advance(sweep, threshold) and len(sweep.boxes(threshold)[0]):
        num_levels += 1
        boxes, bounds, half = _some_boxes(sweep, threshold, 200)
        for box, bound in zip(boxes, bounds, strict=True):
            offsets = np.concatenate([corners, rng.uniform(-1.0, 1.0, (60, 3))])
            values = grid_kernels.objective_at(box + offsets * half, *problem.arguments)
            assert values.max() <= bound
    assert num_levels == len(grid_sweep._LEVELS)


def _sum_of_maxima(problem: GridProblem, box: np.ndarray, half: np.ndarray) -> float:
    """Every point's greatest value over a dense grid of the box's poses, summed."""
    axes = [np.linspace(m - h, m + h, 9) for m, h in zip(box, half, strict=True)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    source, source_weights, target_field, target, target_weights, source_field, *frame = (
        problem.arguments
    )
    none, no_weights, one, total = np.empty((0, 2)), np.empty(0), np.ones(1), 0.0
    for point, weight in zip(source, source_weights, strict=True):
        values = grid_kernels.objective_at(
            poses, point[None, :], one, target_field, none, no_weights, source_field, *frame
        )
        total += weight * values.max()
    for point, weight in zip(target, target_weights, strict=True):
        values = grid_kernels.objective_at(
            poses, none, no_weights, target_field, point[None, :], one, source_field, *frame
        )
        total += weight * values.max()
    return total


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_sums_of_maxima(kind):
    problem = _problem(kind)
    search = grid_search._Search(problem, np.zeros(3), grid_search.SearchLimits(0.1, 1), None)
    sweep, threshold = GridSweep(problem, _window(), _tables(problem)), -0.05
    while _advance(sweep, threshold) and len(sweep.boxes(threshold)[0]):
        boxes, bounds, half = _some_boxes(sweep, threshold, 24)
        exact = np.array([_sum_of_maxima(problem, box, half) for box in boxes])
        assert (exact <= bounds).all()
        if kind in ("one point", "far points"):
            continue
        # Nor are they looser than those of single boxes a cell of the tables larger on each side.
        tables = search._fine if sweep.half < 2.0 else search._coarse
        room = 0.5 if sweep.half < 2.0 else 1.0
        wider, _ = grid_kernels.bound_boxes(
            boxes,
            np.full(len(boxes), np.inf),
            half[0],
            half[1] + room,
            -np.inf,
            False,
            False,
            *tables,
        )
        assert bounds.mean() <= wider.mean()


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("kind", ["noise", "walls", "two sizes"])
def test_every_pose_above_the_threshold_is_in_a_box(kind):
    problem, window = _problem(kind), _window(2.0)
    rng = np.random.default_rng(4)
    poses = window.middle + rng.uniform(-1.0, 1.0, (3000, 3)) * window.half
    poses = np.array([problem.ascend(pose, 2)[0] for pose in poses])
    poses = poses[(np.abs(poses - window.middle) <= window.half).all(axis=1)]
    values = grid_kernels.objective_at(poses, *problem.arguments)
    threshold = float(np.quantile(values, 0.8))
    sweep = GridSweep(problem, window, _tables(problem))
    while _advance(sweep, threshold):
        boxes, _ = sweep.boxes(threshold)
        half = np.array([sweep.half_rad, sweep.half, sweep.half]) + 1e-9
        for pose in poses[values > threshold]:
            assert (np.abs(boxes - pose) <= half).all(axis=1).any()
        assert sweep.greatest_below(threshold) <= threshold
        assert sweep.num_open(threshold) == len(boxes)


@pytest.mark.usefixtures("at_any_cost")
def test_a_sweep_of_everything_tiles_the_window():
    problem, window = _problem("noise"), _window(1.0)
    sweep = GridSweep(problem, window, _tables(problem))
    assert _advance(sweep, -math.inf)
    boxes, bounds = sweep.boxes(-math.inf)
    level = sweep._levels[0]
    assert len(boxes) == level.num_slabs * math.prod(level.shape)
    assert (np.diff(bounds) <= 0).all()
    for axis, half in enumerate((sweep.half_rad, sweep.half, sweep.half)):
        places = np.unique(boxes[:, axis].round(9))
        np.testing.assert_allclose(np.diff(places), 2.0 * half)
        assert places[0] - half <= window.middle[axis] - window.half[axis] + 1e-9
        assert places[-1] + half >= window.middle[axis] + window.half[axis] - 1e-9
    promising = sweep.promising(5)
    np.testing.assert_array_equal(promising[0], boxes[0])


@pytest.mark.parametrize("step", [1, 2, 4])
def test_strips_and_windows_are_those_of_numpy(step):
    rng = np.random.default_rng(6)
    single = rng.integers(-500, 1000, (13, 17)).astype(np.int16)
    found = np.empty((13 + step, 17 + step), np.int16)
    grid_sweep_kernels.slide_back(single, step, found)
    padded = np.pad(single, step)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (step + 1, step + 1))
    expected = windows.max(axis=(2, 3))[::-1, ::-1]
    np.testing.assert_array_equal(found, expected)

    cols, rows, first = 9, 15, -5
    strips = np.empty((step, step, cols, rows, SIDE), np.int16)
    grid_sweep_kernels.cut_strips(single, first, step, strips)
    wide = np.zeros((200, 200), np.int16)
    wide[50:63, 50:67] = single
    for row in range(step):
        for col in range(step):
            part = wide[50 + first + row :: step, 50 + first + col :: step]
            for k in range(cols):
                np.testing.assert_array_equal(strips[row, col, k], part[:rows, k : k + SIDE])


def _search(problem: GridProblem, window: PoseWindow, gap: float) -> grid_search.SearchOutcome:
    limits = grid_search.SearchLimits(gap, 3_000_000)
    return grid_search.search_poses(problem, window, window.middle, limits)


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("kind", ["noise", "walls", "two sizes"])
def test_a_search_finds_the_same_as_without_sweeps(kind, seed, monkeypatch):
    problem, window, gap = _problem(kind, seed), _window(0.5), 0.25
    swept = _search(problem, window, gap)
    again = _search(problem, window, gap)
    monkeypatch.setattr(GridSweep, "advance", lambda *_: False)
    plain = _search(problem, window, gap)
    assert swept.is_complete
    assert plain.is_complete
    assert swept.num_boxes < plain.num_boxes
    assert swept.upper_bound <= swept.lower_bound / (1.0 - gap) + 1e-9
    assert swept.lower_bound == pytest.approx(problem.value(swept.pose), abs=1e-9)
    for one, other in ((swept, plain), (plain, swept)):
        assert one.lower_bound <= other.upper_bound + 1e-9
    np.testing.assert_array_equal(swept.pose, again.pose)
    assert (swept.upper_bound, swept.num_boxes) == (again.upper_bound, again.num_boxes)


@pytest.mark.usefixtures("at_any_cost")
def test_a_sweep_keeps_its_level_where_it_may_not_go_on():
    problem = _problem("noise")
    sweep = GridSweep(problem, _window(), _tables(problem))
    assert _advance(sweep, 0.1)
    boxes, bounds = sweep.boxes(0.1)
    num_tiles = sweep.num_tiles
    assert not sweep.advance(0.1, 1, lambda: False)
    assert not sweep.advance(0.1, 10**6, lambda: True)
    assert not _advance(sweep, 10.0)
    np.testing.assert_array_equal(sweep.boxes(0.1)[0], boxes)
    np.testing.assert_array_equal(sweep.boxes(0.1)[1], bounds)
    assert sweep.num_tiles == num_tiles


def test_small_windows_are_left_to_single_boxes():
    problem = _problem("noise")
    window = PoseWindow(np.array([0.4, 9.3, 7.1]), np.array([0.05, 1.0, 1.0]))
    sweep = GridSweep(problem, window, _tables(problem))
    assert not _advance(sweep, 0.1)
    assert sweep.num_tiles == 0


@pytest.mark.usefixtures("at_any_cost")
def test_a_search_stopped_in_a_sweep_has_true_bounds_and_open_poses():
    problem, window = _problem("noise"), _window(0.5)
    full = _search(problem, window, 0.25)
    num_open = []
    for count in range(1, 8):
        asked = iter([False] * count)
        limits = grid_search.SearchLimits(0.25, 3_000_000, lambda asked=asked: next(asked, True))
        outcome = grid_search.search_poses(problem, window, window.middle, limits)
        assert outcome.is_stopped != outcome.is_complete
        assert outcome.upper_bound >= full.lower_bound - 1e-9
        num_open.append(0 if outcome.is_complete else len(outcome.open_poses))
    assert max(num_open) > 0


@pytest.mark.usefixtures("at_any_cost")
def test_a_search_tells_of_its_sweeps():
    problem, window, told = _problem("noise"), _window(0.5), []
    limits = grid_search.SearchLimits(0.25, 3_000_000)

    def report(_: np.ndarray, lower: float, upper: float, num_boxes: int, num_open: int) -> None:
        told.append((lower, upper, num_boxes, num_open))

    outcome = grid_search.search_poses(problem, window, window.middle, limits, report)
    lower, upper, num_boxes, _ = np.array(told).T
    assert (np.diff(lower) >= 0.0).all()
    assert (upper >= outcome.lower_bound - 1e-9).all()
    assert (np.diff(num_boxes) >= 0).all()
