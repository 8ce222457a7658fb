"""The certificate: bounds hold in boxes, and the answer agrees with exhaustive search."""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    Problem,
    SearchSettings,
    Status,
    Term,
    objective_at,
    search,
)
from uw_dslam_ros2.core.registration.search.field import (
    field_from_samples,
    likelihood_field,
    mixture_field,
)
from uw_dslam_ros2.core.se2 import SE2

pytestmark = pytest.mark.kernels


def mixture_term(source, target, sigma=0.15):
    field = mixture_field(target, np.ones(len(target)), np.full(len(target), sigma))
    return Term(source, np.ones(len(source)), field)


def signed_terms(rng):
    """Both directions at once, fields of either sign."""
    source, target = rng.uniform(-1.0, 1.0, (7, 2)), rng.uniform(0.0, 2.0, (9, 2))
    target_field = field_from_samples(rng.normal(size=(12, 10)), (0.0, 0.0), 0.2)
    source_field = field_from_samples(rng.normal(size=(11, 11)), (-1.0, -1.0), 0.2)
    return [
        Term(source, rng.uniform(0.0, 2.0, 7), target_field),
        Term(target, rng.uniform(0.0, 2.0, 9), source_field, is_inverse=True),
    ]


def some_problems(rng):
    points = rng.uniform(-1.0, 1.0, (12, 2))
    yield [mixture_term(points, rng.uniform(-1.0, 1.0, (15, 2)))]
    yield [mixture_term(points, points)]
    line = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9)])
    yield [mixture_term(line, line + np.array([3.0, -2.0]))]
    yield [mixture_term(np.zeros((1, 2)), points)]
    yield [mixture_term(np.repeat(points[:3], 4, axis=0), points)]
    yield signed_terms(rng)
    yield [signed_terms(rng)[1]]
    clutter = likelihood_field(points, np.ones(12), np.full(12, 0.1), 30.0)
    yield [Term(points[:5], np.ones(5), clutter)]


def bound_box(problem, box, floor=-math.inf):
    """Both bounds and the value at the centre."""
    box, out = np.asarray(box), np.empty(5)
    cells = np.empty((4, problem.points.shape[1]), dtype=np.int32)
    first = kernels.bound_first(problem.sum, problem.bounds.windows, box, floor, cells)
    scratch = np.empty((14, problem.points.shape[1]))
    kernels.bound_second(problem.sum, problem.bounds.curvatures, box, out, cells, scratch)
    return first, out[0], out[1]


@pytest.mark.parametrize(
    ("shrink", "least"), [(1.0, 0), (0.2, 0), (0.05, 30), (0.01, 30), (0.001, 30)]
)
def test_bounds_hold_at_random_poses_of_random_boxes(shrink, least):
    rng = np.random.default_rng(10)
    tried = 0
    for terms in some_problems(rng):
        problem = Problem(terms)
        centre, half = problem.window[:3], problem.window[3:]
        for _ in range(30):
            middle = rng.uniform(centre - half, centre + half)
            widths = half * shrink * 2.0 ** -rng.uniform(0.0, 4.0, 3)
            out = bound_box(problem, [*middle, *widths])
            poses = middle + widths * rng.uniform(-1.0, 1.0, (40, 3))
            poses[:8] = middle + widths * rng.choice([-1.0, 1.0], (8, 3))
            best = max(problem.value_at(pose)[0] for pose in poses)
            assert best <= min(out[0], out[1]) + problem.margin
            tried += math.isfinite(out[1])
            if math.isfinite(out[1]):
                assert out[2] == pytest.approx(problem.value_at(middle)[0], abs=1e-9)
    assert tried >= least  # the second-order bound was among them


def test_second_order_bound_converges_quadratically():
    rng = np.random.default_rng(11)
    for terms in some_problems(rng):
        problem = Problem(terms)
        _, pose = problem.ascend(problem.window[:3] + rng.uniform(-0.1, 0.1, 3))
        slack = []
        for width in (1e-3, 1e-4):
            out = bound_box(problem, [*pose, width, width, width])
            slack.append(out[1] - out[2])
        assert slack[1] <= 0.02 * slack[0] + 1e-7


def test_gradient_and_second_derivatives_are_those_of_the_value():
    rng = np.random.default_rng(12)
    for terms in some_problems(rng):
        problem = Problem(terms)
        for _ in range(20):
            pose = problem.window[:3] + rng.uniform(-0.3, 0.3, 3) * problem.window[3:]
            _, gradient, hessian = problem.value_at(pose)
            direction = rng.normal(size=3)
            step = 1e-6 * direction
            ahead, ahead_gradient, _ = problem.value_at(pose + step)
            behind, behind_gradient, _ = problem.value_at(pose - step)
            scale = 1.0 + np.abs(gradient).max()
            assert (ahead - behind) / 2e-6 == pytest.approx(gradient @ direction, abs=1e-4 * scale)
            # The spline's second derivative jumps at cell edges; none of these steps crosses one.
            change = (ahead_gradient - behind_gradient) / 2e-6
            atol = 1e-3 * (1.0 + np.abs(hessian).max())
            np.testing.assert_allclose(change, hessian @ direction, atol=atol)


def exhaustive_best(problem, rng):
    """Best of a dense lattice of poses, each of the hundred best climbed from."""
    centre, half = problem.window[:3], problem.window[3:]
    axes = [np.linspace(-1.0, 1.0, 25 if k == 0 else 21) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    poses = centre + half * (grid + rng.uniform(-0.02, 0.02, grid.shape))
    values = np.array([problem.value_at(pose)[0] for pose in poses])
    order = np.argsort(-values)[:100]
    return max(problem.ascend(poses[k])[0] for k in order)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_exhaustive_search(seed):
    rng = np.random.default_rng(seed)
    for terms in some_problems(rng):
        outcome = search(terms, SearchSettings(gap=0.001))
        best = exhaustive_best(Problem(terms), rng)
        assert outcome.status is Status.CERTIFIED
        assert best <= outcome.upper_bound
        assert outcome.lower_bound <= objective_at(terms, outcome.T_target_source) + 1e-9
        assert outcome.gap <= 0.0011
        assert outcome.lower_bound >= best * 0.999 - 1e-9


def test_a_planted_motion_is_found_at_huge_offsets():
    rng = np.random.default_rng(20)
    source = rng.uniform(-5.0, 5.0, (30, 2)) + np.array([433_210.0, 5_812_345.0])
    planted = SE2(1.0e6, -2.0e6, 2.0)
    terms = [mixture_term(source, planted.apply(source))]
    outcome = search(terms)
    moved = outcome.T_target_source.apply(source)
    assert np.abs(moved - planted.apply(source)).max() < 1e-3  # 0.03 mm was seen
    assert outcome.status is Status.CERTIFIED


def test_budgets_end_the_search_and_leave_true_bounds():
    rng = np.random.default_rng(21)
    terms = [mixture_term(rng.uniform(-1, 1, (30, 2)), rng.uniform(-1, 1, (30, 2)))]
    full = search(terms, SearchSettings(gap=1e-4))
    ticks = iter(np.arange(1000.0))
    cases = {
        Status.BOXES: search(terms, SearchSettings(gap=1e-4, max_boxes=500)),
        Status.MEMORY: search(terms, SearchSettings(gap=1e-4, max_memory_mb=0.02)),
        Status.TIME: search(
            terms, SearchSettings(gap=1e-4, max_seconds=0.5), clock=lambda: next(ticks)
        ),
        Status.CANCELLED: search(terms, SearchSettings(gap=1e-4), is_cancelled=lambda: True),
    }
    for status, outcome in cases.items():
        assert outcome.status is status
        assert outcome.num_boxes < full.num_boxes
        assert outcome.gap > 1e-4
        assert outcome.lower_bound <= full.upper_bound
        assert outcome.upper_bound >= full.lower_bound


def test_progress_tightens():
    rng = np.random.default_rng(22)
    terms = [mixture_term(rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (20, 2)), 0.05)]
    seen = []
    search(terms, progress=seen.append)
    assert len(seen) > 1
    for before, after in itertools.pairwise(seen):
        assert after.upper_bound <= before.upper_bound
        assert after.lower_bound >= before.lower_bound


def test_the_same_input_gives_the_same_answer():
    outcomes = [search(signed_terms(np.random.default_rng(23))) for _ in range(2)]
    assert outcomes[0].T_target_source == outcomes[1].T_target_source
    assert outcomes[0].upper_bound == outcomes[1].upper_bound
    assert outcomes[0].optima.tobytes() == outcomes[1].optima.tobytes()


def test_a_prior_keeps_the_search_inside():
    rng = np.random.default_rng(24)
    source = rng.uniform(-1.0, 1.0, (15, 2)) + np.array([40.0, -30.0])
    planted = SE2(3.0, -4.0, 1.0)
    terms = [mixture_term(source, planted.apply(source))]
    near = PriorWindow(SE2(3.2, -4.1, 1.1), 0.5, 0.2)
    found = search(terms, prior=near)
    assert found.T_target_source.distance_to(planted)[0] < 0.01
    elsewhere = PriorWindow(SE2(6.0, -4.0, 1.0), 1.0, 0.1)
    other = search(terms, prior=elsewhere)
    assert abs(other.T_target_source.x - 6.0) <= 1.0 + 1e-9
    assert abs(other.T_target_source.yaw - 1.0) <= 0.1 + 1e-9
    assert other.upper_bound < 0.9 * found.lower_bound


FIELD = mixture_field(np.zeros((1, 2)), np.ones(1), np.ones(1))


@pytest.mark.parametrize(
    ("points", "weights"),
    [
        (np.zeros((3, 3)), np.ones(3)),
        (np.zeros((3, 2)), -np.ones(3)),
        (np.zeros((3, 2)), np.ones(4)),
        (np.full((3, 2), np.nan), np.ones(3)),
    ],
)
def test_bad_terms_are_refused(points, weights):
    with pytest.raises(InvalidInputError):
        Term(points, weights, FIELD)


def test_a_search_without_points_is_refused():
    with pytest.raises(InvalidInputError):
        search([Term(np.zeros((0, 2)), np.ones(0), FIELD)])
