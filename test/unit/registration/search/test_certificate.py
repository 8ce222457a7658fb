"""The certificate is real: lower <= true optimum <= upper, on hundreds of small problems.

The judge is slow and simple: the exact sum of Gaussians in NumPy, at every pose that lays a source
point on a target point, and climbed from the best of them.
"""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.baselines.paper_reference import (
    MixturePair,
    register_reference,
)
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    Problem,
    SearchSettings,
    Status,
    Term,
    search,
)
from uw_dslam_ros2.core.registration.search.field import mixture_field
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

UTM = np.array([512_345.0, 4_187_654.0])
GAP = 0.01


class Mixtures:
    """Two weighted point sets with a standard deviation for each pair, and their exact overlap."""

    def __init__(self, source, target, source_weights=None, target_weights=None, sigmas=0.15):
        self.source, self.target = np.atleast_2d(source), np.atleast_2d(target)
        m, n = len(self.source), len(self.target)
        self.source_weights = np.ones(m) if source_weights is None else source_weights
        self.target_weights = np.ones(n) if target_weights is None else target_weights
        self.sigmas = np.broadcast_to(sigmas, (m, n))

    def terms(self, is_inverse=False):
        """As the engine wants it: a field for each kind of point."""
        if is_inverse:
            turned = Mixtures(
                self.target, self.source, self.target_weights, self.source_weights, self.sigmas.T
            )
            return [Term(t.points, t.weights, t.field, is_inverse=True) for t in turned.terms()]
        rows, kinds = np.unique(self.sigmas, axis=0, return_inverse=True)
        return [
            Term(
                self.source[kinds == k],
                self.source_weights[kinds == k],
                mixture_field(self.target, self.target_weights, row),
            )
            for k, row in enumerate(rows)
        ]

    def pairs(self, poses):
        """Every pair's share (K, m, n) at poses (K, 3) theta, x, y about the sets' own centres."""
        x, y = self.source - self.source[0], self.target - self.target[0]
        cos, sin = np.cos(poses[:, 0, None]), np.sin(poses[:, 0, None])
        dx = (cos * x[:, 0] - sin * x[:, 1] + poses[:, 1, None])[:, :, None] - y[:, 0]
        dy = (sin * x[:, 0] + cos * x[:, 1] + poses[:, 2, None])[:, :, None] - y[:, 1]
        weights = self.source_weights[:, None] * self.target_weights
        return weights * np.exp(-0.5 * (dx * dx + dy * dy) / self.sigmas**2)

    def values(self, poses):
        return self.pairs(poses).sum(axis=(1, 2))

    def centred(self, T):
        """Of ``T_target_source``."""
        return np.array([T.yaw, *(T.apply(self.source[0]) - self.target[0])])

    def posed(self, pose):
        """``T_target_source`` of theta, x, y about the centres."""
        turned = SE2(0.0, 0.0, pose[0]).apply(self.source[0])
        return SE2(*(self.target[0] + pose[1:] - turned), pose[0])

    def meetings(self, num_angles=32):
        """All poses that lay a source point on a target point, and half-way between two."""
        theta = np.linspace(-math.pi, math.pi, num_angles, endpoint=False)
        cos, sin = np.cos(theta)[:, None], np.sin(theta)[:, None]
        x, y = self.source - self.source[0], self.target - self.target[0]
        turned = np.stack([cos * x[:, 0] - sin * x[:, 1], sin * x[:, 0] + cos * x[:, 1]], axis=2)
        t = y[None, None, :, :] - turned[:, :, None, :]
        angles = np.broadcast_to(theta[:, None, None, None], (*t.shape[:3], 1))
        return np.concatenate([angles, t], axis=3).reshape(-1, 3)

    def climbed(self, poses, num_steps=60):
        """Every step weighs the pairs by their share and solves for the motion (it never falls).

        exp is convex, so the sum of Gaussians lies above its tangent in the squared distances,
        which a weighted least-squares motion maximises.
        """
        x, y = self.source - self.source[0], self.target - self.target[0]
        for _ in range(num_steps):
            shares = self.pairs(poses) / self.sigmas**2
            total = np.maximum(shares.sum(axis=(1, 2)), 1e-300)[:, None]
            mean_x = np.einsum("kij,id->kd", shares, x) / total
            mean_y = np.einsum("kij,jd->kd", shares, y) / total
            cross = np.einsum("kij,ia,jb->kab", shares, x, y)
            cross -= total[:, :, None] * mean_x[:, :, None] * mean_y[:, None, :]
            theta = np.arctan2(cross[:, 0, 1] - cross[:, 1, 0], cross[:, 0, 0] + cross[:, 1, 1])
            cos, sin = np.cos(theta), np.sin(theta)
            turned = [cos * mean_x[:, 0] - sin * mean_x[:, 1],
                      sin * mean_x[:, 0] + cos * mean_x[:, 1]]  # fmt: skip
            poses = np.column_stack([theta, mean_y - np.column_stack(turned)])
        return poses

    def best(self, poses=None, num_climbs=24):
        """Highest value found, and the local optima."""
        poses = self.meetings() if poses is None else poses
        values = np.concatenate([self.values(part) for part in np.array_split(poses, 20)])
        starts = poses[np.argsort(-values)[:num_climbs]]
        optima = self.climbed(starts)
        return max(values.max(), self.values(optima).max()), optima


def of_kind(kind, rng):
    """One small problem."""
    m, n = rng.integers(1, 13, 2)
    source, target = rng.uniform(-1.0, 1.0, (m, 2)), rng.uniform(-1.0, 1.0, (n, 2))
    if kind == "duplicates":
        return Mixtures(source[rng.integers(0, m, 12)], target[rng.integers(0, n, 12)])
    if kind == "collinear":
        steps = np.sort(rng.uniform(-1.0, 1.0, (2, 12)), axis=1)
        return Mixtures(steps[0, :m, None] * [0.6, 0.8], steps[1, :n, None] * [1.0, -0.2])
    if kind == "symmetric":
        turns = 2.0 * math.pi * np.arange(m) / m
        ring = 0.8 * np.column_stack([np.cos(turns), np.sin(turns)])
        return Mixtures(ring, SE2(0.3, -0.2, rng.uniform(-3.0, 3.0)).apply(ring))
    if kind == "one point":
        return Mixtures(source[:1], target) if rng.integers(2) else Mixtures(source, target[:1])
    if kind == "few against many":
        many = rng.uniform(-1.0, 1.0, (30, 2))
        return Mixtures(many[:3], many, sigmas=0.08)
    if kind == "many against few":
        many = rng.uniform(-1.0, 1.0, (30, 2))
        return Mixtures(many, many[:3], sigmas=0.08)
    if kind == "far away":
        planted = SE2(*(UTM[::-1]), rng.uniform(-3.0, 3.0))
        return Mixtures(source + UTM, planted.apply(np.vstack([source, target]) + UTM))
    if kind == "weights and sigmas":
        sigma_x, sigma_y = rng.choice([0.05, 0.12, 0.3], m), rng.uniform(0.05, 0.3, n)
        return Mixtures(
            source, target, rng.uniform(0.0, 3.0, m), rng.uniform(0.01, 3.0, n),
            np.sqrt(sigma_x[:, None] ** 2 + sigma_y**2),
        )  # fmt: skip
    if kind == "nearly one point":
        return Mixtures(source * 1e-3, target, sigmas=0.1)
    return Mixtures(source, target, sigmas=rng.uniform(0.05, 0.3))


KINDS = [
    "plain", "duplicates", "collinear", "symmetric", "one point", "few against many",
    "many against few", "far away", "weights and sigmas", "nearly one point",
]  # fmt: skip


def certificate(terms, outcome):
    """Bounds of the exact sum: those of the splines, widened by what these miss."""
    slack = sum(float(term.weights.sum()) * term.field.error for term in terms)
    return outcome.lower_bound - slack, outcome.upper_bound + slack, slack


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_enclose_the_exact_optimum(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(25):
        problem = of_kind(kind, rng)
        best, _ = problem.best()
        terms = problem.terms()
        outcome = search(terms, SearchSettings(gap=GAP))
        lower, upper, slack = certificate(terms, outcome)
        value = problem.values(problem.centred(outcome.T_target_source)[None])[0]
        tolerance = 1e-9 * upper
        assert outcome.status is Status.CERTIFIED
        assert best <= upper
        assert lower <= value + tolerance
        assert value <= upper + tolerance
        # No worse than the exhaustive search, and the bounds are as close as they say.
        assert outcome.lower_bound >= (1.0 - GAP) * (best - slack) - tolerance
        assert outcome.upper_bound - outcome.lower_bound <= GAP * outcome.upper_bound + tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_both_directions_have_the_same_optimum(kind):
    """The pairs' sum is one and the same, whichever set carries the field."""
    rng = np.random.default_rng(100 + KINDS.index(kind))
    for _ in range(4):
        problem = of_kind(kind, rng)
        best, _ = problem.best()
        directions = [problem.terms(), problem.terms(is_inverse=True)]
        directions.append(directions[0] + directions[1])
        for terms, share in zip(directions, (1.0, 1.0, 2.0), strict=True):
            outcome = search(terms, SearchSettings(gap=GAP))
            lower, upper, slack = certificate(terms, outcome)
            value = problem.values(problem.centred(outcome.T_target_source)[None])[0]
            assert outcome.status is Status.CERTIFIED
            assert share * max(best, value) <= upper
            assert lower <= share * value + 1e-9
            assert outcome.lower_bound >= (1.0 - GAP) * (share * best - slack) - 1e-9


@pytest.mark.parametrize("kind", ["plain", "weights and sigmas", "symmetric", "far away"])
def test_bounds_hold_in_a_prior_window(kind):
    rng = np.random.default_rng(200 + KINDS.index(kind))
    for _ in range(12):
        problem = of_kind(kind, rng)
        # The window is about the source frame's origin, which a far frame has to bring nearer.
        problem.source = problem.source - np.round(problem.source.mean(axis=0))
        _, optima = problem.best()
        guess = problem.posed(optima[rng.integers(len(optima))] + rng.normal(0.0, 0.2, 3))
        prior = PriorWindow(guess, rng.uniform(0.05, 0.5), rng.uniform(0.05, 1.0))
        half = np.array([prior.half_width_rad, prior.half_width_m, prior.half_width_m])
        inside = [
            problem.centred(SE2(guess.x + x, guess.y + y, guess.yaw + theta))
            for theta, x, y in half * rng.uniform(-1.0, 1.0, (3000, 3))
        ]
        climbed = problem.climbed(np.array(inside[:24]))
        inside += [pose for pose in climbed if is_inside(problem.posed(pose), prior)]
        terms = problem.terms()
        outcome = search(terms, SearchSettings(gap=GAP), prior=prior)
        _, upper, slack = certificate(terms, outcome)
        best = problem.values(np.array(inside)).max()
        assert outcome.status is Status.CERTIFIED
        assert is_inside(outcome.T_target_source, prior)
        assert best <= upper
        assert outcome.lower_bound >= (1.0 - GAP) * (best - slack) - 1e-9


def is_inside(T, prior):
    guess, slack = prior.T_target_source, 1.0 + 1e-9
    shift = max(abs(T.x - guess.x), abs(T.y - guess.y))
    turn = abs(wrap_angle(T.yaw - guess.yaw))
    return shift <= prior.half_width_m * slack and turn <= prior.half_width_rad * slack


@pytest.mark.parametrize("seed", range(8))
def test_engine_and_reference_enclose_the_same_optimum(seed):
    rng = np.random.default_rng(300 + seed)
    m, n = rng.integers(1, 4, 2)
    sigma_x, sigma_y = rng.uniform(0.1, 0.2, m), rng.uniform(0.1, 0.2, n)
    problem = Mixtures(
        rng.uniform(-1.0, 1.0, (m, 2)), rng.uniform(-1.0, 1.0, (n, 2)),
        sigmas=np.sqrt(sigma_x[:, None] ** 2 + sigma_y**2),
    )  # fmt: skip
    pair = MixturePair.build(
        problem.source, problem.target, source_sigma_m=sigma_x, target_sigma_m=sigma_y
    )
    slow = register_reference(pair, gap=0.1, is_gap_relative=True)
    terms = problem.terms()
    outcome = search(terms, SearchSettings(gap=0.001))
    lower, upper, _ = certificate(terms, outcome)
    best, _ = problem.best()
    unit = m * n  # the reference's weights sum to one
    assert slow.is_converged
    assert -slow.upper_bound * unit <= min(best * (1.0 + 1e-9), upper)
    assert max(best, lower) <= -slow.lower_bound * unit * (1.0 + 1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_and_all_their_children_are_bounded(kind):
    """Both bounds of the engine hold at exact values of poses inside, and early ends as well."""
    rng = np.random.default_rng(400 + KINDS.index(kind))
    for is_inverse in (False, True):
        mixtures = of_kind(kind, rng)
        terms = mixtures.terms(is_inverse)
        problem = Problem(terms)
        slack = sum(float(term.weights.sum()) * term.field.error for term in terms)
        for _ in range(12):
            half = problem.window[3:] * 2.0 ** -rng.uniform(0.0, 12.0, 3)
            middle = rng.uniform(-1.0, 1.0, 3) * problem.window[3:] + problem.window[:3]
            if rng.integers(2):
                _, middle = problem.ascend(middle)
            boxes = [(middle, half)]
            halves = 0.5 * half
            boxes += [
                (middle + halves * signs, halves)
                for signs in itertools.product((-1.0, 1.0), repeat=3)
            ]
            for centre, widths in boxes:
                steps = rng.uniform(-1.0, 1.0, (12, 3))
                steps[:4] = np.sign(steps[:4])
                poses = [mixtures.centred(problem.motion_of(*p)) for p in centre + widths * steps]
                highest = mixtures.values(np.array(poses)).max()
                first, early, second = bounds_of(problem, [*centre, *widths], 0.8 * highest)
                assert highest <= min(first, second) + slack + problem.margin
                assert highest <= early + slack + problem.margin
                assert early == first or 0.8 * highest >= early >= first - problem.margin


def bounds_of(problem, box, floor):
    """First-order bound, the same that may end early below a floor, second-order bound."""
    box, out = np.array(box), np.empty(5)
    cells = np.empty((4, problem.points.shape[1]), dtype=np.int32)
    first, early = (
        kernels.bound_first(problem.sum, problem.bounds.windows, box, lowest, cells)
        for lowest in (-math.inf, floor)
    )  # fmt: skip
    scratch = np.empty((14, problem.points.shape[1]))
    kernels.bound_second(problem.sum, problem.bounds.curvatures, box, out, cells, scratch)
    return first, early, out[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0.95, 0.8])
def test_no_rival_is_missed_and_each_is_bounded(kind, keep):
    rng = np.random.default_rng(500 + KINDS.index(kind))
    num_rivals = 0
    for _ in range(3):
        problem = of_kind(kind, rng)
        terms = problem.terms()
        outcome = search(terms, SearchSettings(gap=GAP, keep=keep, rival_share=8.0))
        slack = certificate(terms, outcome)[2] + 1e-9
        _, optima = problem.best(num_climbs=200)
        poses = np.concatenate([optima, problem.meetings(10)])
        values = problem.values(poses)
        for value, pose in zip(values, poses, strict=True):
            assert value <= outcome.upper_bound_near(problem.posed(pose)) + slack
        if outcome.has_all_rivals:
            # Any optimum of that height lies in one of the neighbourhoods.
            for value, pose in zip(values[: len(optima)], optima, strict=True):
                if value > keep * outcome.lower_bound + slack:
                    assert is_known(outcome, problem.posed(pose))
        best = outcome.T_target_source
        for value, upper, x, y, yaw in outcome.rivals:
            exact = problem.values(problem.centred(SE2(x, y, yaw))[None])[0]
            assert exact == pytest.approx(value, abs=slack)
            assert keep * outcome.lower_bound <= value <= upper <= outcome.upper_bound
            assert not is_near(outcome, SE2(x, y, yaw), best, 2.0)
        num_rivals += len(outcome.rivals)
    assert num_rivals or kind != "symmetric"


def is_near(outcome, a, b, radii=1.0):
    around = outcome.neighborhoods
    center = around.problem.source_center
    shift = np.abs(a.apply(center) - b.apply(center)).max()
    turn = around.problem.arm * abs(wrap_angle(a.yaw - b.yaw))
    return max(shift, turn) <= radii * around.radius_m


def is_known(outcome, T):
    problem = outcome.neighborhoods.problem
    known = [problem.motion_of(*row[1:]) for row in outcome.neighborhoods.optima]
    return any(is_near(outcome, T, other) for other in known)


@pytest.mark.kernels
def test_rivals_out_of_budget_leave_a_true_bound():
    rng = np.random.default_rng(600)
    problem = of_kind("duplicates", rng)
    terms = problem.terms()
    outcome = search(terms, SearchSettings(gap=GAP, keep=0.3, rival_share=0.1))
    assert outcome.status is Status.CERTIFIED
    assert not outcome.has_all_rivals
    slack = certificate(terms, outcome)[2] + 1e-9
    poses = problem.meetings()
    for value, pose in zip(problem.values(poses), poses, strict=True):
        if value > 0.5 * outcome.lower_bound:
            assert value <= outcome.upper_bound_near(problem.posed(pose)) + slack
