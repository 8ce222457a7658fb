"""Sweeps: every cell's bound holds, and what a sweep leaves out is below its floor."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    Problem,
    SearchSettings,
    Term,
    search,
)
from uw_dslam_ros2.core.registration.search.field import (
    field_from_samples,
    likelihood_field,
    mixture_field,
)
from uw_dslam_ros2.core.registration.search.sweep import Sweep
from uw_dslam_ros2.core.se2 import SE2

UTM = np.array([512_345.0, 4_187_654.0])
MAX_CELLS = 4_000_000


def mixture(source, target, sigma=0.15, weights=None):
    field = mixture_field(target, np.ones(len(target)), np.full(len(target), sigma))
    return Term(source, np.ones(len(source)) if weights is None else weights, field)


def of_kind(kind, rng):
    """One problem of one forward term."""
    source, target = rng.uniform(-1.0, 1.0, (12, 2)), rng.uniform(-1.0, 1.0, (15, 2))
    if kind == "collinear":
        along = np.sort(rng.uniform(-1.0, 1.0, (2, 12)), axis=1)[:, :, None]
        return Problem([mixture(along[0] * [0.6, 0.8], along[1] * [1.0, -0.2])])
    if kind == "duplicates":
        return Problem([mixture(np.repeat(target[:3], 4, axis=0), target)])
    if kind == "one point":
        return Problem([mixture(source[:1], target)])
    if kind == "few against many":
        return Problem([mixture(source[:3], rng.uniform(-1.0, 1.0, (200, 2)), 0.05)])
    if kind == "many against few":
        return Problem([mixture(rng.uniform(-1.0, 1.0, (200, 2)), target[:3])])
    if kind == "far away":
        return Problem([mixture(source + UTM, SE2(*UTM[::-1], 2.0).apply(source + UTM))])
    if kind == "weights":
        return Problem([mixture(source, target, weights=rng.uniform(0.0, 3.0, 12))])
    if kind == "far points":  # reach further than the tables' rectangles
        source[:3] *= 30.0
        return Problem([mixture(source, target)])
    if kind == "signed":
        field = field_from_samples(rng.normal(size=(12, 10)), (0.0, 0.0), 0.2)
        return Problem([Term(source, rng.uniform(0.0, 2.0, 12), field)])
    field = likelihood_field(target, np.ones(15), np.full(15, 0.2), 0.3)
    return Problem([Term(source, np.ones(12), field)])


KINDS = [
    "likelihood", "collinear", "duplicates", "one point", "few against many", "many against few",
    "far away", "weights", "far points", "signed",
]  # fmt: skip


def meetings(problem, count, rng):
    """Poses that lay some point on one of the highest nodes of the field."""
    field, origin = problem.terms[0].field, problem.frames[0, :2]
    rows, cols = np.unravel_index(
        np.argsort(-field.coefficients, axis=None)[:200], field.coefficients.shape
    )
    for _ in range(count):
        theta, k = rng.uniform(-math.pi, math.pi), rng.integers(len(rows))
        x, y = problem.points[:2, rng.integers(problem.points.shape[1])]
        turned = SE2(0.0, 0.0, theta).apply(np.array([x, y]))
        yield np.array([theta, *(origin + field.pitch_m * np.array([cols[k], rows[k]]) - turned)])


def bound_slowly(problem, box):
    """Sum over the points of the largest cell in the rectangle that each can reach."""
    field, (x0, y0, pitch_m) = problem.terms[0].field, problem.frames[0, :3]
    turned = SE2(0.0, 0.0, box[0]).apply(problem.points[:2].T)
    swing, bow = math.sin(min(box[3], math.pi / 2)), 0.5 * (1.0 - math.cos(box[3]))
    total = 0.0
    for (x, y), weight in zip(turned, problem.points[2], strict=True):
        half = box[4:] + swing * np.abs([y, x]) + bow * np.abs([x, y])
        middle = (1.0 - bow) * np.array([x, y]) + box[1:3] - [x0, y0]
        low = np.floor((middle - half) / pitch_m + 0.5 - 1e-9).astype(int)
        high = np.floor((middle + half) / pitch_m + 0.5 + 1e-9).astype(int) + 1
        is_inside = (low >= 0).all() and (high <= field.coefficients.shape[::-1]).all()
        low = np.maximum(low, 0)
        cells = field.windows[0, low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
        largest = float(cells.max()) if cells.size else 0.0
        total += weight * (largest if is_inside else max(largest, 0.0))
    return total


def levels_of(problem, share, rng):
    """Boxes and bounds of each level around what is above that share of the best value."""
    climbed = [problem.ascend(pose) for pose in meetings(problem, 40, rng)]
    floor = share * max(value for value, _ in climbed)
    sweep, levels = Sweep(problem, MAX_CELLS), []
    while sweep.advance(floor):
        levels.append(sweep.boxes(floor))
    assert len(levels[-1][0])
    return levels, floor, climbed


@pytest.mark.parametrize("kind", KINDS)
def test_every_cell_bounds_the_poses_in_it(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    problem = of_kind(kind, rng)
    for boxes, uppers in levels_of(problem, 0.5, rng)[0]:
        # The highest ones as well, for there the field is.
        for k in [*range(min(20, len(boxes))), *rng.integers(len(boxes), size=40)]:
            steps = rng.uniform(-1.0, 1.0, (12, 3))
            steps[:6] = np.sign(steps[:6])
            poses = boxes[k, :3] + boxes[k, 3:] * steps
            assert max(problem.value_at(pose)[0] for pose in poses) <= uppers[k] + problem.margin


@pytest.mark.parametrize("kind", KINDS)
def test_the_finest_bounds_are_sums_of_maxima(kind):
    rng = np.random.default_rng(20 + KINDS.index(kind))
    problem = of_kind(kind, rng)
    peak = problem.points[2].sum() * np.abs(problem.coefficients).max()
    boxes, uppers = levels_of(problem, 0.5, rng)[0][-1]
    for k in rng.integers(len(boxes), size=60):
        slow = bound_slowly(problem, boxes[k])
        assert uppers[k] >= slow - 1e-7 * peak
        # Points that reach beyond all tables count with the maximum of the field.
        assert uppers[k] <= slow + 1e-4 * peak or kind == "far points"


@pytest.mark.parametrize("kind", KINDS)
def test_poses_above_the_floor_are_in_the_boxes_left(kind):
    rng = np.random.default_rng(40 + KINDS.index(kind))
    problem = of_kind(kind, rng)
    levels, floor, climbed = levels_of(problem, 0.8, rng)
    high = [pose for value, pose in climbed if value > floor + problem.margin]
    assert high
    for boxes, _ in levels:
        for pose in high:
            apart = np.abs(boxes[:, :3] - pose)
            turn = apart[:, 0] % (2.0 * math.pi)
            apart[:, 0] = np.minimum(turn, 2.0 * math.pi - turn)
            assert (apart <= boxes[:, 3:] + 1e-9).all(axis=1).any()


def test_highest_cells_come_first():
    problem = of_kind("likelihood", np.random.default_rng(60))
    sweep = Sweep(problem, MAX_CELLS)
    assert sweep.advance(-math.inf)
    boxes, uppers = sweep.boxes(-math.inf)
    assert (np.diff(uppers) <= 0.0).all()
    assert len(boxes) == sweep.num_cells
    top = sweep.highest(20)
    order = {tuple(box): upper for box, upper in zip(boxes, uppers, strict=True)}
    assert [order[tuple(box)] for box in top] == pytest.approx(uppers[:20])


def test_budgets_stop_a_sweep():
    problem = of_kind("likelihood", np.random.default_rng(61))
    for sweep in (Sweep(problem, 10), Sweep(problem, MAX_CELLS, max_bytes=100.0)):
        assert not sweep.advance(-math.inf)
        assert sweep.num_cells == 0
    sweep = Sweep(problem, MAX_CELLS)
    assert not sweep.advance(-math.inf, lambda: True)
    assert sweep.advance(-math.inf, lambda: False)
    count = sweep.num_cells
    assert not sweep.advance(-math.inf, lambda: True)
    assert len(sweep.boxes(-math.inf)[0]) == count


def test_it_takes_one_forward_term():
    rng = np.random.default_rng(62)
    source, target = rng.uniform(-1.0, 1.0, (2, 9, 2))
    field = mixture_field(source, np.ones(9), np.full(9, 0.2))
    forward, inverse = mixture(source, target), Term(target, np.ones(9), field, is_inverse=True)
    assert Sweep.suits(Problem([forward]))
    assert not Sweep.suits(Problem([inverse]))
    assert not Sweep.suits(Problem([forward, inverse]))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "far away"])
def test_the_search_finds_the_same_without_a_sweep(kind):
    """A prior that excludes nothing is searched box by box (about the source frame's origin)."""
    problem = of_kind(kind, np.random.default_rng(80 + KINDS.index(kind)))
    settings = SearchSettings(gap=0.02)
    window = problem.window
    everywhere = PriorWindow(problem.to_pose(*window[:3]), 2.0 * window[4:].max(), math.pi)
    fast = search(problem.terms, settings)
    slow = search(problem.terms, settings, prior=everywhere)
    assert fast.num_cells > 0
    assert slow.num_cells == 0
    assert fast.lower_bound <= slow.upper_bound
    assert slow.lower_bound <= fast.upper_bound
    assert fast.lower_bound == pytest.approx(slow.lower_bound, rel=0.021)
