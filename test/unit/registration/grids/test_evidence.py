"""What speaks for a match of maps: lines and detail, climbing, windows, rivals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closeness import are_near
from scipy.optimize import minimize

from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import (
    Agreement,
    WallMap,
    measure_agreement,
)
from uw_dslam_ros2.core.registration.grids.judging.lines import off_strongest_lines
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    MatchEvidence,
    PoseEvidence,
    pose_logit,
    probability_of,
    rival_probability,
)
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.problem import build_problem
from uw_dslam_ros2.core.registration.grids.register import match_evidence, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import is_right, make_pair


def _line(start, end, count=100):
    return np.linspace(start, end, count)


def test_straight_walls_hold_no_detail():
    room = [_line((0, 0), (100, 0)), _line((100, 0), (100, 60)), _line((0, 60), (100, 60))]
    points = np.concatenate([*room, _line((0, 0), (0, 60))]) @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    assert not off_strongest_lines(points, 4, 120, 2.5).any()
    left = off_strongest_lines(points, 3, 120, 2.5)
    assert 0 < left.sum() <= 100


def test_a_curve_is_all_detail():
    angles = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    circle = 80.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    assert off_strongest_lines(circle, 4, 120, 2.5).mean() > 0.5


def test_the_climb_ends_on_a_maximum_as_good_as_scipys():
    pair = make_pair("harbour", 0.7, "noisy", 4, size_cells=120)
    problem = build_problem(
        clean_cells(pair.source), clean_cells(pair.target),
        stride=2, sigma_cells=1.0, free_penalty=0.7, max_points=100,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    scale = np.array([1.0 / problem.radius, 1.0, 1.0])
    ours, theirs = [], []
    for _ in range(60):
        start = np.array([rng.uniform(-3, 3), *rng.uniform(10, 50, 2)])
        pose, value = problem.ascend(start)
        assert value >= problem.value(start)
        assert value == pytest.approx(problem.value(pose), abs=1e-12)
        found = minimize(lambda u: -problem.value(u * scale), start / scale, method="BFGS")
        ours.append(value)
        theirs.append(-found.fun)
    # Where it leads to the same hill; far starts may climb different ones.
    same = np.abs(np.array(ours) - theirs) < 1e-3
    assert same.mean() > 0.5
    assert np.mean(ours) > np.mean(theirs) - 0.02


def _agreement(**given):
    values = {
        "overlap": 0.5, "num_walls": 800, "agreement": 0.9, "conflict": 0.04, "inlier_ratio": 0.5,
        "residual_cells": 0.8, "wall_share": 0.08, "num_detail": 200.0,
    }  # fmt: skip
    return Agreement(**{**values, **given})


GOOD = MatchEvidence(PoseEvidence(_agreement(), 1.0, 12.0), (), 0.05, 4.0, 16.0, 0.05)
POOR = PoseEvidence(
    _agreement(agreement=0.6, conflict=0.3, num_walls=80, num_detail=2.0, residual_cells=1.3),
    0.5, 2.0,
)  # fmt: skip


@pytest.mark.parametrize(
    "worse",
    [
        {"agreement": 0.6},
        {"conflict": 0.3},
        {"num_walls": 60, "num_detail": 10.0},
        {"num_detail": 0.0},
    ],
)
def test_weaker_evidence_is_less_probable(worse):
    weaker = replace(GOOD, best=replace(GOOD.best, agreement=_agreement(**worse)))
    assert probability_of(weaker) < probability_of(GOOD)


def test_a_smaller_window_makes_the_same_pose_more_probable():
    poses = [probability_of(replace(GOOD, log_volume=v)) for v in (8.0, 12.0, 16.0)]
    assert poses[0] > poses[1] > poses[2]


def test_good_evidence_is_accepted_and_poor_rivals_do_not_matter():
    config = GridRegistrationConfig()
    assert decide(GOOD, config)[0] is Verdict.ACCEPTED
    assert decide(replace(GOOD, rivals=(POOR,)), config)[0] is Verdict.ACCEPTED
    assert decide(replace(GOOD, best=POOR), config)[0] is not Verdict.ACCEPTED


def test_a_rival_as_convincing_is_ambiguous_however_low_its_score():
    """The half turn of a symmetric place, of which the windows share less."""
    rival = replace(GOOD.best, score=0.4)
    verdict, reason, probability = decide(
        replace(GOOD, rivals=(POOR, rival)), GridRegistrationConfig()
    )
    assert verdict is Verdict.AMBIGUOUS
    assert probability <= 0.51
    assert "another pose" in reason


def test_of_two_poses_that_nothing_tells_apart_each_has_half_of_the_probability():
    evidence = replace(GOOD, rivals=(replace(GOOD.best, score=0.4),))
    alone = probability_of(evidence, is_alone=True)
    assert alone > 0.9
    assert probability_of(evidence) == pytest.approx(0.5 * alone, abs=0.01)


def test_a_match_that_rivals_all_but_reach_is_less_probable_for_itself():
    """Even where none of them is as convincing: accident has made such poses, too."""
    told = []
    for agreement, conflict in ((0.6, 0.2), (0.86, 0.11), (0.86, 0.1)):
        rival = PoseEvidence(_agreement(agreement=agreement, conflict=conflict), 0.4, 5.0)
        evidence = replace(GOOD, best=replace(GOOD.best, surprise=6.0), rivals=(rival,))
        assert rival_probability(evidence) < 0.6
        told.append(probability_of(evidence, is_alone=True))
    assert told[0] > told[1] > told[2]


def test_a_pose_that_explains_little_is_not_made_sure_by_the_weakness_of_others():
    """Two parallel walls of two houses: no other pose explains anything at all."""
    best = PoseEvidence(
        _agreement(agreement=0.777, conflict=0.175, wall_share=0.195, num_detail=55.0), 0.5, 9.3
    )
    alone = replace(GOOD, best=best, rivals=())
    own = pose_logit(best, alone.log_volume)
    assert own < 0.0
    assert probability_of(alone) < 0.75
    assert probability_of(alone) < 1.0 / (1.0 + math.exp(-(2.1 + 2.0 * own))) + 1e-9


def test_what_is_stated_does_not_leap_where_a_verdict_turns():
    """By how much a rival convinces, how much better the source agrees in a mirror, and detail."""
    config = GridRegistrationConfig()

    def with_rival(share):
        agreement = _agreement(agreement=0.9 - 0.5 * share, conflict=0.04 + 0.2 * share)
        return replace(GOOD, rivals=(PoseEvidence(agreement, 0.4, 12.0),))

    def with_decoy(share):
        decoy = replace(GOOD.best, surprise=6.0 + 30.0 * share)
        return replace(GOOD, decoy=decoy, decoy_log_volume=16.0)

    def with_detail(share):
        best = replace(GOOD.best, agreement=_agreement(num_detail=30.0 * share))
        return replace(GOOD, best=best, decoy=best, decoy_log_volume=16.0)

    for change in (with_rival, with_decoy, with_detail):
        told = [decide(change(share), config) for share in np.linspace(0.0, 1.0, 200)]
        assert {verdict for verdict, *_ in told} >= {Verdict.ACCEPTED, Verdict.AMBIGUOUS}
        assert np.abs(np.diff([probability for *_, probability in told])).max() < 0.05


@pytest.mark.parametrize("less", [{"agreement": 0.8}, {"num_detail": 2.0}])
def test_a_rival_that_repeats_walls_only_leaves_a_match_accepted(less):
    """Convincing for itself, but the true pose would agree as well as its twin, and in detail."""
    best = replace(GOOD.best, agreement=_agreement(agreement=0.99, conflict=0.0))
    like = {"agreement": 0.99, "conflict": 0.0, **less}
    rival = PoseEvidence(_agreement(**like), 0.4, 12.0)
    config = GridRegistrationConfig()
    alone = decide(replace(GOOD, best=rival), config)
    assert alone[0] is Verdict.ACCEPTED
    verdict, _, _ = decide(replace(GOOD, best=best, rivals=(rival,)), config)
    assert verdict is Verdict.ACCEPTED


def test_the_same_lead_settles_large_maps_and_leaves_small_ones_open():
    """Of few cells, a few per cent of agreement are chance."""
    verdicts = []
    for num_walls in (150, 3000):
        best = replace(GOOD.best, agreement=_agreement(agreement=0.96, num_walls=num_walls))
        rival = replace(best, agreement=replace(best.agreement, agreement=0.92))
        config = GridRegistrationConfig(max_false_accept=0.3)
        verdicts.append(decide(replace(GOOD, best=best, rivals=(rival,)), config)[0])
    assert verdicts == [Verdict.AMBIGUOUS, Verdict.ACCEPTED]


@pytest.mark.parametrize(
    ("kind", "overlap", "noise", "seed"),
    [("office", 0.2, "noisy", 2), ("corridors", 0.3, "noisy", 0)],
)
def test_evidence_chooses_and_not_the_score(kind, overlap, noise, seed):
    """Another pose lays more walls on walls, and more of them on free space."""
    pair = make_pair(kind, overlap, noise, seed, size_cells=160)
    evidence, poses = match_evidence(pair.source, pair.target)
    logits = [pose_logit(pose, evidence.log_volume) for pose, _ in poses]
    assert logits[0] == max(logits)
    highest, T_highest = max(poses, key=lambda pose: pose[0].score)
    assert highest.score > 1.1 * poses[0][0].score
    assert highest.agreement.conflict > poses[0][0].agreement.conflict
    assert is_right(pair, poses[0][1])
    assert not is_right(pair, T_highest)


def test_a_pose_below_the_best_score_says_so():
    pair = make_pair("office", 0.2, "noisy", 2, size_cells=160)
    config = GridRegistrationConfig(max_false_accept=0.9)  # such a pose is not probable
    result = register_grids(pair.source, pair.target, config)
    assert result.score < result.lower_bound <= result.upper_bound
    assert "another pose has a higher score" in result.reason
    assert is_right(pair, result.T_target_source)
    assert not result.is_certified
    strict = replace(config, is_proof_required=True)
    refused = register_grids(pair.source, pair.target, strict)
    assert result.is_accepted
    assert refused.verdict is Verdict.AMBIGUOUS


def test_evidence_of_a_window_counts_its_poses():
    pair = make_pair("harbour", 0.7, "noisy", 4, size_cells=120)
    whole, _ = match_evidence(pair.source, pair.target)
    T_true = pair.T_target_source
    # Frames at the maps' middles, so that the window is as small as it says.
    source, target = (
        OccupancyMap(GridSpec(0.05, *m.spec.shape, SE2(-3.0, -3.0)), m.values)
        for m in (pair.source, pair.target)
    )
    T_grids = pair.target.spec.T_frame_grid.inverse() @ T_true @ pair.source.spec.T_frame_grid
    centred = SE2(-3.0, -3.0) @ T_grids @ SE2(-3.0, -3.0).inverse()
    near, poses = match_evidence(source, target, prior=PriorWindow(centred, 0.5, 0.1))
    assert near.log_volume < whole.log_volume - 5.0
    assert are_near(poses[0][1], centred, 0.02, 0.01)  # 0.005 m was seen
    # Twice as wide both ways is four times as many poses, twice the turns twice as many; a little
    # more or less, for a window about the source's middle allows for the turns.
    wide, turned = (
        match_evidence(source, target, prior=PriorWindow(centred, *half))[0]
        for half in ((1.0, 0.1), (0.5, 0.2))
    )
    assert wide.log_volume - near.log_volume == pytest.approx(math.log(4.0), abs=0.15)
    assert turned.log_volume - near.log_volume == pytest.approx(math.log(2.0), abs=0.25)


def test_chance_is_the_share_of_the_common_area_near_walls():
    values = np.zeros((100, 100), np.int8)
    values[50] = 100
    walls = WallMap(clean_cells(OccupancyMap(GridSpec(0.1, 100, 100), values)))
    same = measure_agreement(walls, walls, SE2())
    assert same.wall_share == pytest.approx(0.05, abs=0.02)  # five rows of a hundred
    assert same.agreement == 1.0
    assert same.num_detail == 0.0
