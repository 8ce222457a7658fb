"""Sweeps: every cell's bound holds, and what a sweep leaves out is below its floor."""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.search import sweep as sweep_module
from uw_dslam_ros2.core.registration.search import sweep_kernels
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    Problem,
    SearchSettings,
    Status,
    Term,
    maximise,
    search,
)
from uw_dslam_ros2.core.registration.search.field import (
    field_from_samples,
    likelihood_field,
    mixture_field,
)
from uw_dslam_ros2.core.registration.search.sweep import Sweep
from uw_dslam_ros2.core.registration.search.tile_kernels import SIDE
from uw_dslam_ros2.core.se2 import SE2

pytestmark = pytest.mark.kernels

UTM = np.array([512_345.0, 4_187_654.0])
WIDTHS = np.array([*sweep_module._WIDTHS, 10**6])


@pytest.fixture
def at_any_cost(monkeypatch):
    """Sweep even where single boxes are cheaper."""
    monkeypatch.setattr(sweep_module, "_BOX", 1e9)


def mixture(source, target, sigma=0.15, weights=None):
    field = mixture_field(target, np.ones(len(target)), np.full(len(target), sigma))
    return Term(source, np.ones(len(source)) if weights is None else weights, field)


def signed_field(rng, shape, kind="noise"):
    """Walls and free space on a lattice of 0.2 m."""
    values = rng.uniform(-0.7, 1.0, shape)
    if kind == "walls":
        values = np.where(rng.random(shape) < 0.1, 1.0, -0.5)
    if kind == "harsh":
        values = np.where(rng.random(shape) < 0.5, 1.0, -2.0)
    return field_from_samples(values, (-1.3, 0.4), 0.2)


def maps(rng, kind):
    """Both directions; the window and the source's centre are off the middle."""
    shapes = ((9, 20), (16, 10)) if kind == "two sizes" else ((12, 11), (10, 13))
    (source, target), terms = shapes, []
    for own, other, is_inverse in ((source, target, False), (target, source, True)):
        points = rng.uniform(0.0, 0.2, (1 if kind == "one wall" else 12, 2)) * own[::-1] - (
            1.3,
            -0.4,
        )
        if kind == "far walls":
            points[:2] *= 8.0
        weights = rng.random(len(points))
        field = signed_field(rng, other, kind).refined()
        terms.append(Term(points, 0.5 * weights / weights.sum(), field, is_inverse))
    return Problem(terms)


def of_kind(kind, rng):
    """One problem."""
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
        return Problem([Term(source, rng.uniform(0.0, 2.0, 12), signed_field(rng, (12, 10)))])
    if kind == "inverse":
        field = mixture_field(source, np.ones(12), np.full(12, 0.2))
        return Problem([Term(target, rng.uniform(0.0, 2.0, 15), field, is_inverse=True)])
    if kind == "two kernels":
        return Problem([mixture(source[:5], target, 0.2), mixture(source[5:], target, 0.13)])
    if kind in MAPS:
        return maps(rng, kind)
    field = likelihood_field(target, np.ones(15), np.full(15, 0.2), 0.3)
    return Problem([Term(source, np.ones(12), field)])


MAPS = ["noise", "walls", "one wall", "far walls", "two sizes", "harsh"]
KINDS = [
    "likelihood", "collinear", "duplicates", "one point", "few against many", "many against few",
    "far away", "weights", "far points", "signed", "inverse", "two kernels", *MAPS,
]  # fmt: skip


def meetings(problem, count, rng):
    """Poses that lay some point on one of the highest nodes of its field."""
    for _ in range(count):
        t = rng.integers(len(problem.terms))
        term, origin = problem.terms[t], problem.frames[t, :2]
        rows, cols = np.unravel_index(
            np.argsort(-term.field.coefficients, axis=None)[:200], term.field.coefficients.shape
        )
        theta, k = rng.uniform(-math.pi, math.pi), rng.integers(len(rows))
        point = problem.points[:2, rng.integers(*problem.rows[t, :2])]
        node = origin + term.field.pitch_m * np.array([cols[k], rows[k]])
        if term.is_inverse:
            point, node = node, point
        yield np.array([theta, *(node - SE2(0.0, 0.0, theta).apply(point))])


def bound_slowly(problem, box, more=0.0):
    """Sum over the points of the largest cell in the square that each can reach, `more` [m]."""
    total, (theta, x, y, delta, *half) = 0.0, box
    max_sin, versine = math.sin(min(delta, math.pi / 2)), 0.5 * (1.0 - math.cos(delta))
    turn = SE2(0.0, 0.0, theta).rotation()
    for term, row, (x0, y0, pitch_m, *_) in zip(
        problem.terms, problem.rows, problem.frames, strict=True
    ):
        for point, weight in zip(
            problem.points[:2, row[0] : row[1]].T, problem.points[2, row[0] : row[1]], strict=True
        ):
            if term.is_inverse:
                turned, middle = turn.T @ (point - [x, y]), np.zeros(2)
                reach = np.abs(turn.T) @ half * (1.0 + 2.0 * versine)
                reach += max_sin * (np.abs(turn.T) @ half)[::-1]
            else:
                turned, middle, reach = turn @ point, np.array([x, y]), np.array(half)
            reach = reach + max_sin * np.abs(turned[::-1]) + versine * np.abs(turned) + more
            middle = (1.0 - versine) * turned + middle - [x0, y0]
            low = np.floor((middle - reach) / pitch_m + 0.5 - 1e-9).astype(int)
            high = np.floor((middle + reach) / pitch_m + 0.5 + 1e-9).astype(int) + 1
            high = low + WIDTHS[np.searchsorted(WIDTHS, (high - low).max())]
            shape = term.field.coefficients.shape
            is_inside = (low >= 0).all() and (high <= shape[::-1]).all()
            low = np.maximum(low, 0)
            cells = term.field.tables[0][0, low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
            largest = float(cells.max()) if cells.size else 0.0
            total += weight * (largest if is_inside else max(largest, 0.0))
    return total


def sum_of_maxima(problem, box):
    """Every point's greatest value over a dense grid of the box's poses, summed."""
    total = 0.0
    theta, x, y = (
        g.ravel()
        for g in np.meshgrid(
            *(m + h * np.linspace(-1, 1, 9) for m, h in zip(box[:3], box[3:], strict=True))
        )
    )
    cos, sin = np.cos(theta)[:, None], np.sin(theta)[:, None]
    for term, row, frame in zip(problem.terms, problem.rows, problem.frames, strict=True):
        px, py, weights = problem.points[:3, row[0] : row[1]]
        if term.is_inverse:
            px, py = px - x[:, None], py - y[:, None]
            at = np.stack([cos * px + sin * py, cos * py - sin * px], axis=-1)
        else:
            at = np.stack(
                [cos * px - sin * py + x[:, None], sin * px + cos * py + y[:, None]], axis=-1
            )
        values = term.field.values(at.reshape(-1, 2) - frame[:2] + term.field.origin)
        total += float(values.reshape(at.shape[:2]).max(axis=0) @ weights)
    return total


def levels_of(problem, share, rng):
    """Boxes and bounds of each level around what is above that share of the best value."""
    climbed = [problem.ascend(pose) for pose in meetings(problem, 40, rng)]
    floor = share * max(value for value, _ in climbed)
    sweep, levels = Sweep(problem), []
    while sweep.advance(floor):
        levels.append(sweep.boxes(floor))
        assert sweep.num_open(floor) == len(levels[-1][0])
    assert len(levels) == len(sweep._levels)
    assert len(levels[-1][0])
    return levels, floor, climbed


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("kind", KINDS)
def test_every_cell_bounds_the_poses_in_it(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    problem = of_kind(kind, rng)
    for boxes, uppers in levels_of(problem, 0.5, rng)[0]:
        # The highest ones as well, for there the field is.
        for k in [*range(min(20, len(boxes))), *rng.integers(len(boxes), size=40)]:
            steps = rng.uniform(-1.0, 1.0, (20, 3))
            steps[:8] = list(itertools.product((-1.0, 1.0), repeat=3))
            poses = boxes[k, :3] + boxes[k, 3:] * steps
            assert max(problem.value_at(pose)[0] for pose in poses) <= uppers[k] + problem.margin


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("kind", KINDS)
def test_the_finest_bounds_are_sums_of_maxima(kind):
    rng = np.random.default_rng(20 + KINDS.index(kind))
    problem = of_kind(kind, rng)
    boxes, uppers = levels_of(problem, 0.5, rng)[0][-1]
    chosen = rng.integers(len(boxes), size=60)
    wider = []
    for k in chosen:
        assert uppers[k] >= sum_of_maxima(problem, boxes[k])
        if len(problem.terms) == 1 and not problem.terms[0].is_inverse:
            # Squares of whole cells, and sums of what is rounded up to 2^-15 of the peak.
            slow = bound_slowly(problem, boxes[k])
            assert uppers[k] <= slow + 1e-4 * problem.peak or kind == "far points"
        wider.append(bound_slowly(problem, boxes[k], problem.pitch_m))
    # Tables of other kinds are no looser than squares a cell larger on each side.
    assert uppers[chosen].mean() <= np.mean(wider) + 1e-4 * problem.peak or "far" in kind


@pytest.mark.usefixtures("at_any_cost")
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


@pytest.mark.usefixtures("at_any_cost")
@pytest.mark.parametrize("kind", ["likelihood", "noise"])
def test_a_sweep_of_everything_tiles_the_window(kind):
    problem = of_kind(kind, np.random.default_rng(60))
    problem.window[:] = 0.4, 1.3, -0.7, 1.0, 2.23, 1.57
    sweep = Sweep(problem)
    assert sweep.advance(-math.inf)
    boxes, uppers = sweep.boxes(-math.inf)
    assert (np.diff(uppers) <= 0.0).all()
    low, high = boxes[:, :3] - boxes[:, 3:], boxes[:, :3] + boxes[:, 3:]
    np.testing.assert_allclose(low.min(axis=0), problem.window[:3] - problem.window[3:])
    np.testing.assert_allclose(high.max(axis=0), problem.window[:3] + problem.window[3:])
    assert np.prod(high - low, axis=1).sum() == pytest.approx(8.0 * problem.window[3:].prod())
    for axis in range(3):
        np.testing.assert_allclose(
            np.unique(low[:, axis].round(9))[1:], np.unique(high[:, axis].round(9))[:-1]
        )
    np.testing.assert_array_equal(sweep.highest(5)[0], boxes[0])


@pytest.mark.parametrize("step", [1, 2, 4])
def test_strips_and_windows_are_those_of_numpy(step):
    rng = np.random.default_rng(6)
    single = rng.integers(-500, 1000, (13, 17)).astype(np.int16)
    found = np.empty((13 + step, 17 + step), np.int16)
    sweep_kernels.slide_back(single, step, found)
    padded = np.pad(single, step)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (step + 1, step + 1))
    np.testing.assert_array_equal(found, windows.max(axis=(2, 3))[::-1, ::-1])

    cols, rows, first = 9, 15, -5
    strips = np.empty((step, step, cols, rows, SIDE), np.int16)
    sweep_kernels.cut_strips(single, first, step, strips)
    wide = np.zeros((200, 200), np.int16)
    wide[50:63, 50:67] = single
    for row in range(step):
        for col in range(step):
            part = wide[50 + first + row :: step, 50 + first + col :: step]
            for k in range(cols):
                np.testing.assert_array_equal(strips[row, col, k], part[:rows, k : k + SIDE])


@pytest.mark.parametrize("more", [(0, 0), (1, 1), (3, 0), (2, 30)])
def test_windows_of_tables_hold_the_greatest_of_what_they_cover(more):
    table = np.random.default_rng(8).integers(-500, 1000, (11, 9)).astype(np.int16)
    wide = np.empty_like(table)
    sweep_kernels.widen(table, *more, wide)
    for row, col in np.ndindex(table.shape):
        assert wide[row, col] == table[row : row + more[0] + 1, col : col + more[1] + 1].max()


@pytest.mark.parametrize("size", [1.0, 2.0, 1.7, 3.3])
def test_cells_of_tables_hold_the_greatest_of_the_fields_cells(size):
    windows = np.random.default_rng(7).uniform(-2.0, 1.0, (23, 17)).astype(np.float32)
    shape = [2 + math.ceil(side / size) for side in windows.shape]
    table, unit = np.empty(shape, np.int16), 2.0 / 32000.0
    sweep_kernels.coarsen(windows, size, unit, 2, table)
    assert not table[:2].any()
    assert not table[:, :2].any()
    for row, col in itertools.product(*(range(side - 2) for side in shape)):
        ends = [(math.floor(k * size), math.ceil((k + 1) * size)) for k in (row, col)]
        greatest = windows[slice(*ends[0]), slice(*ends[1])].max()
        assert greatest <= table[2 + row, 2 + col] * unit <= greatest + 2.0 * unit


@pytest.mark.parametrize("num_layers", [1, 3, len(sweep_module._WIDTHS)])
def test_turned_squares_hold_what_they_reach_and_nothing_behind_the_tables(num_layers):
    rng = np.random.default_rng(num_layers)
    values, theta, delta, first = rng.integers(0, 1000, (30, 24), np.int16), 0.4, 0.25, -20
    found = []
    for behind in (-30000, 30000):
        memory = np.full((num_layers + 2, *values.shape), behind, np.int16)
        tables = memory[:num_layers]
        for table, width in zip(tables, sweep_module._WIDTHS.tolist(), strict=False):
            sweep_kernels.widen(values, width - 1, width - 1, table)
        single = np.empty((45, 45), np.int16)
        sweep_kernels.turned_maxima(
            theta, delta, np.array([first, first, 45, 45]), 1.0, tables,
            np.array([0.0, 0.0, 24.0, 30.0]), np.array([11.0, 13.0]),
            sweep_module._LAYER_OF_WIDTH, 0.01, single,
        )  # fmt: skip
        found.append(single)
    np.testing.assert_array_equal(*found)
    for _ in range(3000):
        col, row = rng.integers(0, 45, 2)
        ux, uy = first + np.array([col, row]) + rng.random(2)
        angle = theta + rng.uniform(-delta, delta)
        cos, sin = math.cos(angle), math.sin(angle)
        x, y = math.floor(cos * ux + sin * uy + 11.0), math.floor(cos * uy - sin * ux + 13.0)
        if 0 <= x < 24 and 0 <= y < 30:
            assert values[y, x] <= found[0][row, col]


@pytest.mark.usefixtures("at_any_cost")
def test_a_sweep_keeps_its_level_where_it_may_not_go_on():
    problem = of_kind("noise", np.random.default_rng(61))
    assert not Sweep(problem, 10).advance(-math.inf)
    sweep = Sweep(problem)
    assert not sweep.advance(-math.inf, lambda: True)
    assert sweep.num_tiles == 0
    assert sweep.advance(0.1, lambda: False)
    boxes, bounds = sweep.boxes(0.1)
    num_tiles = sweep.num_tiles
    assert not sweep.advance(0.1, lambda: True)
    assert not sweep.advance(10.0)
    np.testing.assert_array_equal(sweep.boxes(0.1)[0], boxes)
    np.testing.assert_array_equal(sweep.boxes(0.1)[1], bounds)
    assert sweep.num_tiles == num_tiles


def test_small_windows_are_left_to_single_boxes():
    problem = of_kind("noise", np.random.default_rng(62))
    problem.window[3:] = 0.05, 0.2, 0.2
    assert not Sweep(problem).advance(0.1)


SMALL = [kind for kind in KINDS if kind not in ("far away", "far walls", "one wall", "harsh")]


@pytest.mark.parametrize("kind", SMALL)
def test_the_search_finds_the_same_without_a_sweep(kind, monkeypatch):
    terms, settings = of_kind(kind, np.random.default_rng(80 + KINDS.index(kind))).terms, None
    settings = SearchSettings(gap=0.25 if kind in MAPS else 0.02, max_boxes=3_000_000)
    swept, again = search(terms, settings), search(terms, settings)
    monkeypatch.setattr(Sweep, "advance", lambda *_: False)
    plain = search(terms, settings)
    assert swept.num_cells > 0
    assert plain.num_cells == 0
    for outcome in (swept, plain):
        assert outcome.status is Status.CERTIFIED
        assert outcome.gap <= settings.gap + 1e-9
    assert swept.lower_bound <= plain.upper_bound
    assert plain.lower_bound <= swept.upper_bound
    np.testing.assert_array_equal(swept.pose, again.pose)
    assert (swept.upper_bound, swept.num_boxes) == (again.upper_bound, again.num_boxes)


@pytest.mark.parametrize("kind", ["likelihood", "noise"])
def test_a_window_is_swept_as_well(kind):
    """What a prior excludes is not found, and what it allows is, with or without a sweep."""
    problem = of_kind(kind, np.random.default_rng(90))
    best = search(problem.terms, SearchSettings(gap=0.1))
    elsewhere = best.pose + np.array([0.5 * math.pi, 0.0, 0.0])
    window = np.array([*elsewhere, 0.9, 1.5, 1.5])
    found = []
    for is_swept in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sweep_module, "_BOX", 1e9 if is_swept else 0.0)
            found.append(
                maximise(Problem(problem.terms, window=window.copy()), SearchSettings(0.1))
            )
    assert found[0].num_cells > 0
    assert found[1].num_cells == 0
    for one, other in (found, found[::-1]):
        assert one.status is Status.CERTIFIED
        assert one.lower_bound <= other.upper_bound
        assert (np.abs(one.pose - window[:3]) <= window[3:] + 1e-9).all()


@pytest.mark.usefixtures("at_any_cost")
def test_a_search_stopped_in_a_sweep_has_true_bounds_and_open_poses():
    problem = of_kind("noise", np.random.default_rng(63))
    full = maximise(problem, SearchSettings(gap=0.25))
    num_open = []
    for count in range(1, 8):
        asked = iter([False] * count)
        outcome = maximise(
            problem, SearchSettings(gap=0.25), is_cancelled=lambda asked=asked: next(asked, True)
        )
        assert outcome.status in (Status.CANCELLED, Status.CERTIFIED)
        assert outcome.upper_bound >= full.lower_bound - 1e-9
        num_open.append(0 if outcome.is_complete else len(outcome.open_poses))
    assert max(num_open) > 0


@pytest.mark.usefixtures("at_any_cost")
def test_a_search_tells_of_its_sweeps():
    told = []
    problem = of_kind("noise", np.random.default_rng(64))
    outcome = maximise(problem, SearchSettings(gap=0.25), progress=told.append)
    assert (np.diff([t.lower_bound for t in told]) >= 0.0).all()
    assert (np.array([t.upper_bound for t in told]) >= outcome.lower_bound - 1e-9).all()
    assert (np.diff([t.num_boxes for t in told]) >= 0).all()
    assert told[0].num_boxes > 0
