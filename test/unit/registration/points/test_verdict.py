"""The table of a match of points: sentences and numbers say what was decided, and by what."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.registration.points.verdict import (
    _RULES,
    PointCase,
    PoseHypothesis,
    decide_points,
)
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.registration.rules import first_that_applies

BEST = PoseHypothesis(80.0, 1e-6 * np.eye(3), 80.0, 0.9, -math.inf)
RIVAL = PoseHypothesis(20.0, 1e-6 * np.eye(3), 20.0, 0.9, -30.0)
GOOD = PointCase([BEST, RIVAL], True, 0.01, 0.1, 1.0, False, 0.95)


def random_case(rng):
    poses = []
    for k in range(rng.integers(1, 6)):
        evidence = rng.normal(6.0, 8.0)
        poses.append(
            PoseHypothesis(
                evidence, np.diag(rng.exponential(0.02, 3) ** 2), evidence + rng.exponential(6.0),
                rng.random(), -math.inf if k == 0 else -rng.exponential(4.0),
            )
        )  # fmt: skip
    poses.sort(key=lambda pose: -pose.evidence)
    return PointCase(
        poses, bool(rng.random() > 0.05), 0.02, 0.1, 1.0, bool(rng.random() < 0.1),
        rng.uniform(0.5, 0.999),
    )  # fmt: skip


def test_each_sentence_states_the_numbers_that_decided(rng):
    deciding = set()
    for _ in range(5000):
        case = random_case(rng)
        if rng.random() < 0.01:
            case = replace(case, spacing_m=math.nan)
        verdict, reason, probability = decide_points(case)
        rule = first_that_applies(_RULES, case)
        deciding.add(_RULES.index(rule))
        said = re.search(r"(-?[\d.e+-]+), expected at (most|least) (-?[\d.e+-]+)", reason)
        if said is None:
            assert verdict in (
                Verdict.ACCEPTED, Verdict.BUDGET_EXHAUSTED, Verdict.TOO_FEW_FEATURES,
            )  # fmt: skip
            continue
        value, limit = float(said[1]), float(said[3])
        assert value > limit if said[2] == "most" else value < limit
        if "nats," in reason or "in nats" in reason.split(":")[-1]:
            measured, tested = case.best.evidence, case.least_evidence
        elif "metres" in reason:
            measured, tested = case.deviation_m, case.max_deviation_m
        else:
            measured, tested = case.probability, case.min_posterior
        assert value == pytest.approx(measured, rel=0.01, abs=0.051)
        assert limit == pytest.approx(tested, rel=0.01, abs=0.051)
        assert probability <= case.probability
    assert deciding == set(range(len(_RULES)))


def test_what_is_accepted_breaks_no_limit(rng):
    num_accepted = 0
    for _ in range(3000):
        case = random_case(rng)
        verdict, _, probability = decide_points(case)
        assert verdict is not Verdict.NOT_ENOUGH_OVERLAP  # of points, overlap is not known
        if verdict is Verdict.ACCEPTED:
            num_accepted += 1
            assert case.is_complete
            assert probability == case.probability >= case.min_posterior
            assert case.deviation_m <= case.max_deviation_m
    assert num_accepted > 300


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["evidence", "independent_evidence", "pair_share", "log_odds"])
@pytest.mark.parametrize("which", [0, 1])
def test_no_hypothesis_that_is_not_finite_is_passed(which, name, bad):
    poses = [BEST, RIVAL]
    poses[which] = replace(poses[which], **{name: bad})
    refused(replace(GOOD, hypotheses=poses), bad)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["gap", "spacing_m", "arm_m"])
def test_no_measure_that_is_not_finite_is_passed(name, bad):
    refused(replace(GOOD, **{name: bad}), bad)


def refused(case, bad):
    assert decide_points(GOOD)[0] is Verdict.ACCEPTED
    verdict, reason, probability = decide_points(case)
    assert verdict is Verdict.TOO_FEW_FEATURES
    assert f"is {bad}" in reason
    assert probability == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_pose_of_which_the_covariance_is_open_is_not_accepted(bad):
    best = replace(BEST, covariance=np.full((3, 3), bad))
    assert decide_points(replace(GOOD, hypotheses=[best]))[0] is Verdict.AMBIGUOUS


def test_a_pose_for_which_nothing_speaks_is_improbable():
    best = replace(BEST, evidence=-math.inf, independent_evidence=-math.inf)
    verdict, _, probability = decide_points(replace(GOOD, hypotheses=[best]))
    assert (verdict, probability) == (Verdict.IMPROBABLE, 0.0)
