"""Nothing outside of what the maps show decides on a match: the same pair, told otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.pose_graph import invert_covariance
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.register import match_evidence, register_grids
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.sim.maps.pairs import make_pair, pair_errors
from uw_dslam_ros2.sim.maps.variants import VARIANTS, mirrored

_TRIES = ((0.7, "noisy", True), (0.5, "clean", True), (0.5, "noisy", False))
_PAIRS = [
    (kind, *details)
    for kind in ("harbour", "lake", "office", "corridors", "cave", "oblique")
    for details in _TRIES
]
_COARSE = "cells twice as large"  # half of the walls' detail is gone: the only change that takes
_BAR_MOVES = 0.05
_EXACT = ("a quarter turn of both", "a quarter turn of the source", "exchanged")


def _answer(pair):
    evidence, poses = match_evidence(pair.source, pair.target)
    verdict, _, probability = decide(evidence, GridRegistrationConfig())
    return verdict, probability, poses[0][1]


@pytest.mark.parametrize("place", _PAIRS)
def test_the_same_maps_told_otherwise_get_the_same_answer(place):
    kind, overlap, noise, is_matching = place
    pair = make_pair(kind, overlap, noise, 7100, size_cells=120, is_matching=is_matching)
    verdict, probability, T_target_source = _answer(pair)
    is_accepted = verdict is Verdict.ACCEPTED
    known = replace(pair, T_target_source=T_target_source)
    for name, change in VARIANTS.items():
        other = change(known)
        again, its_probability, T_found = _answer(other)
        off_cells = pair_errors(other, T_found)[0] / pair.source.spec.resolution_m
        if name == _COARSE:
            assert is_accepted or again is not Verdict.ACCEPTED, name
            assert off_cells < 2.0 or again is not Verdict.ACCEPTED, name  # one of its own
            continue
        if name in _EXACT:
            assert its_probability == pytest.approx(probability, abs=1e-6), name
        if (again is Verdict.ACCEPTED) != is_accepted:
            assert abs(its_probability - probability) < _BAR_MOVES, name
        if again is Verdict.ACCEPTED:
            assert off_cells < 0.5, name


@pytest.mark.parametrize("place", [p for p in _PAIRS if p[3]])
def test_a_mirrored_map_is_never_accepted(place):
    kind, overlap, noise, _ = place
    pair = make_pair(kind, overlap, noise, 7100, size_cells=120)
    assert _answer(replace(pair, source=mirrored(pair.source)))[0] is not Verdict.ACCEPTED


@pytest.mark.parametrize("place", [("lake", 0.7, "noisy"), ("office", 0.5, "clean")])
def test_exchanged_maps_have_the_inverse_answer(place):
    pair = make_pair(*place, 7100, size_cells=100)
    there = register_grids(pair.source, pair.target)
    back = register_grids(pair.target, pair.source)
    assert (back.verdict, back.reason, back.probability) == (
        there.verdict, there.reason, there.probability
    )  # fmt: skip
    assert back.T_target_source.as_array() == pytest.approx(
        there.T_target_source.inverse().as_array(), abs=1e-9
    )
    expected = invert_covariance(there.covariance, there.T_target_source)
    assert back.covariance == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert np.array_equal(back.source_points, there.target_points)
    assert np.array_equal(back.target_points, there.source_points)


@pytest.mark.parametrize("name", ["source", "target"])
def test_what_a_map_lacks_is_said_of_the_right_one(name):
    pair = make_pair("lake", 0.7, "clean", 7100, size_cells=60)
    bare = replace(pair.source, values=np.where(pair.source.known, 0, -1).astype(np.int8))
    maps = {"source": pair.source, "target": pair.source} | {name: bare}
    assert f"the {name} map has 0 wall cells" in register_grids(**maps).reason


def test_a_turned_map_has_its_cells_where_they_were(rng):
    pair = make_pair("harbour", 0.7, "clean", 1, size_cells=60)
    points = rng.uniform(0.2, 2.8, (200, 2)) + pair.source.spec.corners()[0]
    for name in ("a quarter turn of the source", "margins about both", "specks far away",
                 "cells half as large"):  # fmt: skip
        other = VARIANTS[name](pair).source
        found = [
            occupancy.values[tuple(occupancy.spec.cells_of(points).T)]
            for occupancy in (pair.source, other)
        ]
        assert np.array_equal(*found), name
