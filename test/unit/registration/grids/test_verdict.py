"""The table of a match of maps: sentences and numbers say what was decided, and by what."""

import dataclasses
import math
import re
from collections import Counter
from dataclasses import replace

import pytest

from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import Agreement
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    MODELS,
    MatchEvidence,
    PoseEvidence,
    probability_of,
    rival_probability,
)
from uw_dslam_ros2.core.registration.grids.judging.verdict import (
    _RULES,
    Proof,
    _Case,
    decide,
)
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.registration.rules import at_least, at_most, first_that_applies

AGREEMENT = Agreement(0.5, 800, 0.95, 0.01, 0.5, 0.8, 0.08, 200.0)
GOOD = MatchEvidence(PoseEvidence(AGREEMENT, 1.0, 12.0), (), 0.05, 4.0, 16.0, 0.05)
PROVEN = Proof(num_boxes=7, score=0.5, lower_bound=0.5, upper_bound=0.52)


def random_pose(rng):
    agreement = rng.beta(4, 1)
    conflict = rng.choice([rng.beta(1, 6), 0.6 * rng.random()])
    return PoseEvidence(
        Agreement(
            rng.random() ** 1.5, int(rng.integers(20, 3000)), agreement,
            min(conflict, 1.0 - agreement), rng.random(), 2.0 * rng.random(),
            0.25 * rng.random(), rng.exponential(150.0) * (rng.random() > 0.2),
        ),
        rng.random(),
        rng.exponential(8.0),
    )  # fmt: skip


def random_case(rng):
    rivals = tuple(random_pose(rng) for _ in range(rng.integers(0, 4)))
    evidence = MatchEvidence(
        random_pose(rng), rivals, rng.exponential(0.8), rng.uniform(1, 9), rng.uniform(5, 18), 0.05
    )
    config = GridRegistrationConfig(is_proof_required=bool(rng.random() < 0.3))
    if rng.random() < 0.5:
        config = replace(
            config,
            max_false_accept=rng.random(), min_overlap=0.4 * rng.random(),
        )  # fmt: skip
    if rng.random() < 0.5:
        evidence = replace(evidence, decoy=random_pose(rng), decoy_log_volume=rng.uniform(5, 18))
    proof = Proof(
        is_complete=bool(rng.random() < 0.8), is_optimum=bool(rng.random() < 0.8),
        is_cancelled=bool(rng.random() < 0.05), num_boxes=9, score=0.41, lower_bound=0.5,
        upper_bound=0.9,
    )  # fmt: skip
    return evidence, config, proof


def test_a_rival_that_large_maps_deny_beyond_doubt_has_no_probability():
    best = PoseEvidence(replace(AGREEMENT, num_walls=400_000), 1.0, 12.0)
    rival = PoseEvidence(replace(AGREEMENT, num_walls=400_000, agreement=0.05), 1.0, 12.0)
    assert rival_probability(replace(GOOD, best=best, rivals=(rival,))) == pytest.approx(0.0)


# What a sentence begins with, what it measures, the limit, and on which side of it it must lie.
SENTENCES = {
    "share of the smaller map's": (
        Verdict.NOT_ENOUGH_OVERLAP,
        lambda e, _: e.best.agreement.overlap,
        lambda c, _: c.min_overlap,
        "least",
    ),
    "share of the common walls": (
        Verdict.CONTRADICTED,
        lambda e, _: e.best.agreement.conflict,
        lambda c, p: 0.4 if p >= 1.0 - c.max_false_accept else 0.24,
        "most",
    ),
    "another pose agrees about as well": (
        Verdict.AMBIGUOUS,
        lambda _, p: p,
        lambda c, _: 1.0 - c.max_false_accept,
        "least",
    ),
    "in a mirror the source agrees better": (
        Verdict.AMBIGUOUS,
        lambda _, p: p,
        lambda c, _: 1.0 - c.max_false_accept,
        "least",
    ),
    "hardly more than straight walls agrees": (
        Verdict.AMBIGUOUS,
        lambda _, p: p,
        lambda c, _: 1.0 - c.max_false_accept,
        "least",
    ),
    "what agrees are a few straight walls": (
        Verdict.AMBIGUOUS,
        lambda _, p: p,
        lambda c, _: 1.0 - c.max_false_accept,
        "least",
    ),
    "right with probability": (
        Verdict.IMPROBABLE,
        lambda _, p: p,
        lambda c, _: 1.0 - c.max_false_accept,
        "least",
    ),
}


def numbers_in(sentence):
    """Value, side and limit of the first comparison in a sentence, as printed."""
    found = re.search(r"([\d.]+)(%?), expected at (most|least) ([\d.]+)(%?)", sentence)
    scale = 0.01 if found[2] else 1.0
    return scale * float(found[1]), found[3], scale * float(found[4])


def test_each_sentence_states_the_numbers_that_decided(rng):
    seen = Counter()
    for _ in range(6000):
        evidence, config, proof = random_case(rng)
        verdict, reason, stated = decide(evidence, config, proof=proof)
        probability = probability_of(evidence)
        assert stated == (0.0 if verdict is Verdict.TOO_FEW_FEATURES else probability)
        begin = next((text for text in SENTENCES if reason.startswith(text)), None)
        if begin is None:
            seen[verdict, reason.split(",")[0][:20] if verdict != Verdict.ACCEPTED else ""] += 1
            continue
        seen[begin] += 1
        expected, measured, limit, side = SENTENCES[begin]
        value, said_side, said_limit = numbers_in(reason)
        assert verdict is expected
        assert said_side == side
        assert value > said_limit if side == "most" else value < said_limit
        assert said_limit == pytest.approx(limit(config, probability), abs=0.0051)
        if measured is not None:
            assert value == pytest.approx(measured(evidence, probability), abs=0.0051)
    assert set(SENTENCES) <= set(seen)
    assert {verdict for verdict, *_ in (k for k in seen if isinstance(k, tuple))} == {
        Verdict.ACCEPTED, Verdict.AMBIGUOUS, Verdict.BUDGET_EXHAUSTED,
    }  # fmt: skip


def test_what_is_accepted_breaks_no_limit_and_the_name_fits_the_cause(rng):
    num_accepted = 0
    for _ in range(6000):
        evidence, config, proof = random_case(rng)
        verdict, _, probability = decide(evidence, config, proof=proof)
        agreement = evidence.best.agreement
        if verdict is Verdict.NOT_ENOUGH_OVERLAP:
            assert agreement.overlap < config.min_overlap
        if verdict is Verdict.IMPROBABLE:
            assert probability < 1.0 - config.max_false_accept
        if verdict is not Verdict.ACCEPTED:
            continue
        num_accepted += 1
        assert agreement.overlap >= config.min_overlap
        assert agreement.conflict <= 0.4
        assert probability >= 1.0 - config.max_false_accept
        assert not proof.is_cancelled
        assert not config.is_proof_required or (proof.is_complete and proof.is_optimum)
    assert num_accepted > 300


def test_every_line_of_the_table_can_decide(rng):
    """A line that never does is one that nobody can break."""
    deciding = set()
    for _ in range(6000):
        evidence, config, proof = random_case(rng)
        if rng.random() < 0.01:
            evidence = replace(evidence, deviation_m=math.nan)
        case = _Case(evidence, config, MODELS, proof)
        deciding.add(_RULES.index(first_that_applies(_RULES, case)))
    assert deciding == set(range(len(_RULES)))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("is_rival", [False, True])
@pytest.mark.parametrize(
    "name", ["score", "surprise", *(field.name for field in dataclasses.fields(Agreement))]
)
def test_no_number_of_a_pose_that_is_not_finite_is_passed(name, is_rival, bad):
    pose = GOOD.best
    if name in ("score", "surprise"):
        spoilt = replace(pose, **{name: bad})
    else:
        spoilt = replace(pose, agreement=replace(pose.agreement, **{name: bad}))
    rivals = (replace(pose, score=0.1, surprise=1.0),)
    evidence = replace(GOOD, rivals=(spoilt, *rivals)) if is_rival else replace(GOOD, best=spoilt)
    refused(evidence, PROVEN, bad)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["deviation_m", "extent_m", "log_volume", "cell_m"])
def test_no_number_of_a_match_that_is_not_finite_is_passed(name, bad):
    refused(replace(GOOD, **{name: bad}), PROVEN, bad)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["score", "lower_bound", "upper_bound"])
def test_no_number_of_a_proof_that_is_not_finite_is_passed(name, bad):
    refused(GOOD, replace(PROVEN, **{name: bad}), bad)


def refused(evidence, proof, bad):
    config = GridRegistrationConfig(max_false_accept=1.0)
    assert decide(GOOD, config, proof=PROVEN)[0] is Verdict.ACCEPTED
    verdict, reason, probability = decide(evidence, config, proof=proof)
    assert verdict is Verdict.TOO_FEW_FEATURES
    assert f"is {bad}" in reason
    assert probability == 0.0


def test_numbers_that_look_equal_get_more_digits():
    assert at_most(0.24, 0.2) == "24%, expected at most 20%"
    assert at_most(0.2404, 0.24) == "24.04%, expected at most 24.00%"
    assert at_least(0.7499, 0.75, ".2f") == "0.7499, expected at least 0.7500"


def test_a_corridor_is_accepted_as_what_it_is():
    """What the graph needs is the covariance; who reads the answer is told."""
    config = GridRegistrationConfig()
    loose = replace(GOOD, deviation_m=1.3)
    verdict, reason, probability = decide(loose, config)
    assert verdict is Verdict.ACCEPTED
    assert "along it the standard deviation is 1.3 m" in reason
    assert probability == decide(GOOD, config)[2]
    assert "standard deviation" not in decide(GOOD, config)[1]
