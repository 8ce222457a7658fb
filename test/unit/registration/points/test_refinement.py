"""Pairing, noise and evidence, against sums over everything and closed forms."""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.baselines import procrustes
from uw_dslam_ros2.core.registration.points import refine_kernels
from uw_dslam_ros2.core.registration.points.correlation import lattice_maxima
from uw_dslam_ros2.core.registration.points.design_effect import design_effect
from uw_dslam_ros2.core.registration.points.evidence import EvidenceModel, Outline
from uw_dslam_ros2.core.registration.points.refine import PointModel, polish, refine
from uw_dslam_ros2.core.registration.points.refinement import Refinement
from uw_dslam_ros2.core.registration.points.rivals import log_contributions, log_odds
from uw_dslam_ros2.core.se2 import SE2

pytestmark = pytest.mark.kernels

PLANTED = SE2(0.1, -0.2, 0.7)


def sum_over_matchings(activity):
    """Sum over all sets of pairs in which no row and no column occurs twice."""
    m, n = activity.shape
    total = 0.0
    for size in range(min(m, n) + 1):
        for rows in itertools.combinations(range(m), size):
            for columns in itertools.permutations(range(n), size):
                total += math.prod(activity[i, j] for i, j in zip(rows, columns, strict=True))
    return total


def evidence_model(model, volume=10.0):
    spacing = math.sqrt(model.area_m2 / len(model.target))
    outlines = Outline.of(model.source), Outline.of(model.target)
    return EvidenceModel(
        model.source, model.target, *outlines, volume, 1.0, spacing, spacing, has_prior=False
    )


@pytest.mark.parametrize("seed", range(8))
def test_the_value_is_close_to_the_sum_over_all_matchings_and_not_above(seed):
    rng = np.random.default_rng(seed)
    source, target = rng.uniform(-1.0, 1.0, (4, 2)), rng.uniform(-1.0, 1.0, (5, 2))
    target = target[np.argsort(target[:, 0])]
    sigma, num_pairs, area = rng.uniform(0.2, 0.6), rng.uniform(0.5, 3.0), 4.0
    odds = num_pairs / ((4.0 - num_pairs) * (5.0 - num_pairs))
    square = ((source[:, None] - target[None]) ** 2).sum(axis=2)
    gauss = np.exp(-0.5 * square / sigma**2) * (square <= (4.0 * sigma) ** 2)
    activity = odds * area / (2.0 * math.pi * sigma**2) * gauss
    choices = (
        math.lgamma(5.0) - math.lgamma(5.0 - num_pairs) - math.lgamma(num_pairs + 1.0)
        + math.lgamma(6.0) - math.lgamma(6.0 - num_pairs)
    )  # fmt: skip
    exact = math.log(sum_over_matchings(activity)) - num_pairs * math.log(odds) - choices
    found = refine_kernels.expectation_maximisation(
        source, np.ones(4), target, np.ones(5), area, 1e-9, 1.0,
        np.array([0.0, 0.0, 0.0, sigma, num_pairs]), 0, 0.0, 200, np.zeros((3, 3)),
    )  # fmt: skip
    assert exact - 0.4 < found < exact + 1e-3


def test_a_climb_ends_at_the_least_squares_motion_of_clear_pairs():
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    source = grid + rng.uniform(-0.2, 0.2, grid.shape)
    source -= source.mean(axis=0)
    target = PLANTED.apply(source) + rng.normal(0.0, 0.01, source.shape)
    model = PointModel.of(source, target, 30.0, 1e-6, 1.0)
    start = np.array([0.72, 0.2, -0.1])
    found = polish(model, refine(model, evidence_model(model), start, 0.3)[1])
    best = procrustes(source, target)
    translation, rotation = found.pose().distance_to(best)
    assert translation < 1e-4
    assert rotation < 1e-4
    assert found.num_pairs > 29.0
    residual = target - best.apply(source)
    assert found.sigma_m == pytest.approx(math.sqrt((residual**2).mean()), rel=0.02)


def test_one_target_serves_one_source_point():
    """A crowd of source points on one target is one pair, not many."""
    source = np.vstack([np.full((10, 2), 0.5), [[-1.0, 0.0], [0.0, -1.0], [0.0, 1.0]]])
    source[:10] += np.random.default_rng(2).normal(0.0, 1e-3, (10, 2))
    target = np.array([[-1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.5, 0.5]])
    model = PointModel.of(source, target, 9.0, 1e-4, 0.5)
    _, found = refine(model, evidence_model(model), np.zeros(3), 0.05)
    assert 3.0 < found.num_pairs <= 4.0


@pytest.mark.parametrize("count", [30, 200])
def test_an_outline_has_the_area_of_what_it_is_a_sample_of(count):
    rng = np.random.default_rng(3)
    areas = []
    for _ in range(60):
        points = PLANTED.apply(rng.uniform(-1.0, 1.0, (count, 2)))
        outline = Outline.of(points)
        areas.append(outline.area_m2)
        assert outline.holds(points).all()
        assert not outline.holds(points + 10.0).any()
    assert np.mean(areas) == pytest.approx(4.0, rel=0.03)


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.outer(np.arange(9.0), [0.6, 0.8])])
def test_points_without_area_have_a_thin_outline(points):
    outline = Outline.of(points)
    assert outline.area_m2 > 0.0
    assert outline.holds(points).all()
    assert outline.area_m2 < 10.0


def test_independent_points_count_fully_and_walls_do_not():
    rng = np.random.default_rng(4)
    uniform = [rng.uniform(-1.0, 1.0, (2, 80, 2)) for _ in range(20)]
    effects = [_effect(a, b) for a, b in uniform]
    assert np.mean(effects) < 1.05
    along = rng.uniform(-1.0, 1.0, (2, 80))
    walls = np.stack([along, np.where(np.arange(80) % 2, 0.7, -0.7) * np.ones((2, 80))], axis=2)
    assert _effect(*walls) > 10.0


def test_points_that_come_in_bunches_count_as_bunches():
    rng = np.random.default_rng(5)
    bunched = np.repeat(rng.uniform(-1.0, 1.0, (40, 2)), 8, axis=0)
    bunched += rng.normal(0.0, 0.005, bunched.shape)
    target = np.repeat(rng.uniform(-1.0, 1.0, (40, 2)), 8, axis=0)
    assert 4.0 < _effect(bunched, target) < 9.0


def _effect(source, target):
    far = np.array([50.0, 0.0])
    return design_effect(source, target, Outline.of(target), far, 0.06, 10.0)


def test_the_lattice_has_the_planted_pose_and_keeps_to_its_budget():
    rng = np.random.default_rng(6)
    source = rng.uniform(-1.0, 1.0, (25, 2))
    target = np.vstack([PLANTED.apply(source), rng.uniform(-1.0, 1.0, (25, 2))])
    poses = lattice_maxima(source, target, 0.1, 10.0, 5, 1e9)
    translation, rotation = SE2(*poses[0, 1:], poses[0, 0]).distance_to(PLANTED)
    assert translation < 0.1
    assert rotation < 0.1
    gaps = [
        max(abs(a[1:] - b[1:]).max(), abs(math.remainder(a[0] - b[0], math.tau)))
        for a, b in itertools.combinations(poses, 2)
    ]
    assert min(gaps) > 0.1
    assert len(lattice_maxima(source, target, 0.1, 10.0, 5, 1e5)) == 0


@pytest.mark.parametrize("mean", [0.0, 0.2, 0.4])
def test_odds_of_a_rival_are_those_of_points_drawn_again(mean):
    rng = np.random.default_rng(9)
    best, rival = rng.normal(mean, 1.0, 80), rng.normal(0.0, 1.0, 80)
    drawn = rng.integers(0, 80, (20_000, 80))
    share = float(((best - rival)[drawn].sum(axis=1) < 0.0).mean())
    odds = math.exp(log_odds(best, rival, 1.0))
    assert odds / (1.0 + odds) == pytest.approx(min(share, 0.5), abs=0.02)
    assert log_odds(best, rival, 4.0) >= log_odds(best, rival, 1.0)


def test_contributions_of_points_far_apart_sum_to_the_likelihood_of_their_pairs():
    rng = np.random.default_rng(10)
    target = rng.permutation(np.stack(np.meshgrid(range(6), range(6)), -1).reshape(-1, 2) * 1.0)
    source = target[:20] + rng.normal(0.0, 0.02, (20, 2))
    model = PointModel.of(source, target, 36.0, 1e-6, 0.5)
    _, found = refine(model, evidence_model(model), np.zeros(3), 0.05)
    contributions = log_contributions(source, target, found, 36.0)
    # The one-to-one likelihood divides by the number of ways to choose that many pairs.
    assert (contributions > 3.0).all()
    assert contributions.sum() > found.log_likelihood > 0.3 * contributions.sum()
    away = log_contributions(source + 0.5, target, found, 36.0)
    assert np.abs(away).max() < 1e-6


def test_every_noise_counts_alike_beforehand():
    """The evidence of a smaller noise falls as the likelihood integrated over all noises does."""
    model = PointModel.of(*np.random.default_rng(8).uniform(-1.0, 1.0, (2, 40, 2)), 4.0, 1e-6, 0.5)
    evidence, num_pairs, all_noises = evidence_model(model), 30.0, np.linspace(1e-4, 0.5, 50_000)

    def log_integral(estimate):
        ratio = estimate / all_noises
        log_likelihood = num_pairs * (2.0 * np.log(ratio) + 1.0 - ratio**2)
        return math.log(np.exp(log_likelihood).mean())

    def value(estimate):
        found = Refinement(np.zeros(3), estimate, num_pairs, 0.0, np.eye(3))
        return evidence.of(found)

    assert value(0.1) - value(0.02) == pytest.approx(log_integral(0.1) - log_integral(0.02), 0.01)


def test_evidence_prefers_overlap_but_not_within_a_given_window():
    rng = np.random.default_rng(7)
    points = rng.uniform(-1.0, 1.0, (40, 2))
    model = PointModel.of(points, points, 4.0, 1e-6, 0.5)
    free = evidence_model(model)
    value, found = refine(model, free, np.zeros(3), 0.1)
    other, _ = refine(model, free, np.array([0.0, 1.5, 1.5]), 0.1)
    assert value > other
    assert value == free.of(found)
    assert free.log_overlap(SE2()) > 2.0
    assert free.log_overlap(SE2(1.5, 0.0, 0.0)) < 1.0
