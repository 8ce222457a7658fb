"""Point sets in, verdict out."""

import math

import numpy as np
import pytest
from closeness import are_near
from scipy.stats import chi2

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration import (
    PriorWindow,
    RegistrationConfig,
    Verdict,
    register_point_sets,
)
from uw_dslam_ros2.core.registration.points.verdict import (
    PointCase,
    PoseHypothesis,
    decide_points,
)
from uw_dslam_ros2.core.se2 import SE2

PLANTED = SE2(0.4, -0.7, 2.2)


def scene(rng, num_common, num_source_only=0, num_target_only=0, noise=0.0):
    """Points of which some are in both sets; those of the source first."""
    common = rng.uniform(-1.0, 1.0, (num_common, 2))
    source = np.vstack([common, rng.uniform(-1.0, 1.0, (num_source_only, 2))])
    target = np.vstack([common, rng.uniform(-1.0, 1.0, (num_target_only, 2))])
    target[:num_common] += rng.normal(0.0, noise, (num_common, 2))
    return source, PLANTED.apply(target)


@pytest.mark.parametrize("method", ["likelihood", "gmrbnb"])
@pytest.mark.parametrize(("clutter", "noise"), [(0, 0.0), (40, 0.0), (40, 0.02)])
def test_a_planted_motion_is_found_and_proven(method, clutter, noise):
    source, target = scene(np.random.default_rng(1), 40, 0, clutter, noise)
    result = register_point_sets(source, target, RegistrationConfig(method=method))
    translation, rotation = result.T_target_source.distance_to(PLANTED)
    assert result.verdict is Verdict.ACCEPTED, result.reason
    assert translation < 1e-6 + 0.4 * noise  # 0.24 and 0.07 times the noise were seen
    assert rotation < 1e-6 + 0.15 * noise
    assert result.is_certified
    assert result.lower_bound <= result.upper_bound
    assert result.gap <= 0.03
    assert result.inlier_ratio > 0.9


@pytest.mark.parametrize(("m", "n"), [(60, 20), (20, 60)])
def test_it_does_not_matter_which_set_is_the_larger(m, n):
    source, target = scene(np.random.default_rng(2), 20, m - 20, n - 20, 0.005)
    there = register_point_sets(source, target)
    back = register_point_sets(target, source)
    assert there.is_accepted
    assert back.is_accepted
    translation, rotation = there.T_target_source.distance_to(back.T_target_source.inverse())
    assert translation < 1e-6
    assert rotation < 1e-6


def test_huge_offsets_do_no_harm():
    source, target = scene(np.random.default_rng(3), 30, 5, 10)
    here = register_point_sets(source, target)
    there = register_point_sets(source + np.array([433_000.0, 5_800_000.0]), target - 1e6)
    expected = SE2(-1e6, -1e6, 0.0) @ here.T_target_source @ SE2(-433_000.0, -5_800_000.0, 0.0)
    shifted = source + np.array([433_000.0, 5_800_000.0])
    assert there.is_accepted
    moved = there.T_target_source.apply(shifted) - expected.apply(shifted)
    assert np.abs(moved).max() < 1e-5


def test_unrelated_sets_are_refused():
    rng = np.random.default_rng(4)
    for _ in range(5):
        result = register_point_sets(rng.uniform(-1, 1, (40, 2)), rng.uniform(-1, 1, (40, 2)))
        assert result.verdict is Verdict.IMPROBABLE, result.reason
        assert result.probability < 0.3  # 0.1 was seen


def test_a_symmetric_set_is_ambiguous_and_names_its_twin():
    rng = np.random.default_rng(5)
    half = rng.uniform(0.1, 1.0, (15, 2))
    source = np.vstack([half, -half])
    result = register_point_sets(source, PLANTED.apply(source))
    assert result.verdict is Verdict.AMBIGUOUS, result.reason
    twin = PLANTED @ SE2(0.0, 0.0, math.pi)
    poses = [result.T_target_source, result.rivals[0].T_target_source]
    for expected in (PLANTED, twin):
        assert min(pose.distance_to(expected)[1] for pose in poses) < 1e-6
    assert result.rivals[0].score > 0.9


@pytest.mark.parametrize("m", [0, 1, 3])
def test_too_few_points_are_an_answer(m):
    result = register_point_sets(np.zeros((m, 2)), np.random.default_rng(6).normal(size=(9, 2)))
    assert result.verdict is Verdict.TOO_FEW_FEATURES
    assert not result.is_certified
    assert result.T_target_source is None
    assert len(result.source_points) == len(result.is_inlier) == result.num_source_points == m


def test_equal_points_are_never_accepted():
    rng = np.random.default_rng(7)
    result = register_point_sets(np.zeros((12, 2)), rng.uniform(-1.0, 1.0, (12, 2)))
    assert not result.is_accepted


def test_a_prior_is_kept():
    source, target = scene(np.random.default_rng(8), 30, 0, 10)
    near = PriorWindow(SE2(0.45, -0.65, 2.1), 0.2, 0.3)
    assert register_point_sets(source, target, prior=near).is_accepted
    wrong = PriorWindow(SE2(0.4, -0.7, 0.0), 0.2, 0.3)
    result = register_point_sets(source, target, prior=wrong)
    assert not result.is_accepted
    assert abs(result.T_target_source.yaw) <= 0.3 + 1e-9


def test_budget_and_cancel_end_a_match():
    source, target = scene(np.random.default_rng(9), 30, 30, 100, 0.02)
    short = register_point_sets(source, target, RegistrationConfig(max_boxes=100, gap=1e-4))
    stopped = register_point_sets(
        source, target, RegistrationConfig(gap=1e-4), is_cancelled=lambda: True
    )
    ticks = iter(np.arange(1000.0))
    late = register_point_sets(
        source,
        target,
        RegistrationConfig(max_seconds=1.5, gap=1e-4),
        clock=lambda: float(next(ticks)),
    )
    for result in (short, stopped, late):
        assert result.verdict is Verdict.BUDGET_EXHAUSTED
        assert result.gap > 1e-4
        assert not result.is_certified


def test_same_input_same_answer():
    source, target = scene(np.random.default_rng(10), 20, 10, 10, 0.01)
    a, b = (register_point_sets(source, target) for _ in range(2))
    assert a.T_target_source == b.T_target_source
    assert a.covariance.tobytes() == b.covariance.tobytes()


def test_own_weights_and_deviations_are_used():
    rng = np.random.default_rng(11)
    source, target = scene(rng, 25, 0, 15)
    result = register_point_sets(
        source, target,
        source_weights=rng.uniform(0.5, 2.0, 25), target_weights=rng.uniform(0.5, 2.0, 40),
        source_sigma_m=rng.choice([0.02, 0.05], 25), target_sigma_m=rng.uniform(0.02, 0.05, 40),
    )  # fmt: skip
    assert result.is_accepted
    assert are_near(result.T_target_source, PLANTED, 1e-6, 1e-6)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"source": np.zeros((5, 3))}, "source"),
        ({"target": np.full((5, 2), np.inf)}, "target"),
        ({"source_weights": np.zeros(5)}, "source_weights"),
        ({"target_sigma_m": np.ones(3)}, "target_sigma_m"),
    ],
)
def test_bad_input_is_named(arguments, name):
    points = np.random.default_rng(12).normal(size=(5, 2))
    with pytest.raises(InvalidInputError, match=name):
        register_point_sets(**({"source": points, "target": points} | arguments))


@pytest.mark.parametrize("noise", [0.01, 0.02, 0.05])
def test_the_covariance_is_calibrated(noise):
    """Mean normalised error squared within its 95 % interval about three degrees of freedom."""
    num_trials, errors = 24, []
    for seed in range(num_trials):
        source, target = scene(np.random.default_rng([30, seed]), 60, 10, 10, noise)
        result = register_point_sets(source, target, RegistrationConfig(gap=0.1))
        assert result.is_accepted, result.reason
        error = result.T_target_source.as_array() - PLANTED.as_array()
        errors.append(error @ np.linalg.solve(result.covariance, error))
    low, high = chi2.ppf([0.025, 0.975], 3 * num_trials) / num_trials
    assert low < np.mean(errors) < high


def test_ten_percent_in_common_is_refused():
    for seed in range(4):
        source, target = scene(np.random.default_rng([31, seed]), 5, 45, 45, 0.02)
        result = register_point_sets(source, target, RegistrationConfig(max_boxes=40_000))
        assert not result.is_accepted, result.reason


def walls(rng, segments, noise=0.01, step=0.1):
    """Points along segments (K, 4) of x, y, x, y, sampled afresh with every call."""
    points = []
    for x0, y0, x1, y1 in segments:
        count = round(math.hypot(x1 - x0, y1 - y0) / step)
        along = (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count
        points.append(np.column_stack([x0 + along * (x1 - x0), y0 + along * (y1 - y0)]))
    together = np.vstack(points)
    return together + rng.normal(0.0, noise, together.shape)


CORRIDOR = [(-5.0, -1.0, 5.0, -1.0), (-5.0, 1.0, 5.0, 1.0)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("segments", [CORRIDOR, CORRIDOR[:1]], ids=["corridor", "line"])
def test_walls_along_which_one_can_slide_are_ambiguous(segments, seed):
    rng = np.random.default_rng([13, seed])
    result = register_point_sets(walls(rng, segments), PLANTED.apply(walls(rng, segments)))
    assert result.verdict is Verdict.AMBIGUOUS, result.reason
    assert result.probability <= 0.1  # 0.0005 was seen
    assert result.rivals[0].score > 0.9


def test_a_convincing_rival_counts_as_much_as_the_points_prefer_it():
    def verdict(log_odds, rival_evidence):
        poses = [
            PoseHypothesis(evidence, 1e-6 * np.eye(3), evidence, 0.9, odds)
            for evidence, odds in ((80.0, -math.inf), (rival_evidence, log_odds))
        ]
        return decide_points(PointCase(poses, True, 0.01, 0.1, 1.0, False, 0.95))

    # By the points' scatter either could have won, however many nats lie between them.
    assert verdict(math.log(0.5), 70.0)[0] is Verdict.AMBIGUOUS
    assert verdict(-10.0, 70.0)[0] is Verdict.ACCEPTED
    # A rival that is no better than chance is not asked.
    assert verdict(math.log(0.5), -6.0)[0] is Verdict.ACCEPTED
    assert verdict(-math.inf, 79.9)[0] is Verdict.AMBIGUOUS


def test_a_room_with_a_corner_of_its_own_is_accepted():
    rng = np.random.default_rng(14)
    room = [
        (0.0, 0.0, 5.0, 0.0), (5.0, 0.0, 5.0, 2.0), (5.0, 2.0, 3.2, 2.0), (3.2, 2.0, 3.2, 4.1),
        (3.2, 4.1, 0.0, 4.1), (0.0, 4.1, 0.0, 0.0), (1.0, 1.2, 1.7, 1.4), (1.7, 1.4, 1.5, 2.3),
    ]  # fmt: skip
    result = register_point_sets(walls(rng, room), PLANTED.apply(walls(rng, room)))
    assert result.is_accepted, result.reason
    translation, rotation = result.T_target_source.distance_to(PLANTED)
    assert translation < 0.012  # 0.004 m and 0.04 degrees were seen
    assert rotation < math.radians(0.15)
    # As wide as the error, and wider than that of as many independent points.
    assert result.covariance[0, 0] > 2.0 * 0.01**2 * 2.0 / len(walls(rng, room))
