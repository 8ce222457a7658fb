"""A source seen in a mirror, where no pose is right, tells what two maps reach by chance."""

from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    lead_over_decoy,
    probability_of,
)
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.preparation import in_a_mirror, prepare_maps
from uw_dslam_ros2.core.registration.grids.register import match_evidence, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.sim.maps.pairs import make_pair
from uw_dslam_ros2.sim.maps.variants import mirrored

_CONFIG = GridRegistrationConfig()


@pytest.fixture(scope="module")
def lake():
    """A shore that agrees by 98 % with itself in a mirror, as far as the two overlap."""
    return make_pair("lake", 0.7, "noisy", 7100, size_cells=120)


def test_a_map_in_a_mirror_is_the_map_that_is_made_of_it(lake):
    _, scales = prepare_maps(lake.source, lake.target, _CONFIG)
    _, made = prepare_maps(mirrored(lake.source), lake.target, _CONFIG)
    seen, expected = in_a_mirror(scales[0][0]), made[0][0]
    assert isinstance(seen, WallMap)
    for name in ("wall", "free", "known", "row", "col"):
        np.testing.assert_allclose(getattr(seen.cells, name), getattr(expected.cells, name))
    np.testing.assert_array_equal(seen.distance, expected.distance)


def test_a_lake_in_a_mirror_is_ambiguous(lake):
    evidence, _ = match_evidence(mirrored(lake.source), lake.target)
    assert probability_of(evidence, is_alone=True) > 0.75  # of the poses as they are, convincing
    assert lead_over_decoy(evidence) < -0.4
    verdict, reason, probability = decide(evidence, _CONFIG)
    assert verdict is Verdict.AMBIGUOUS
    assert "in a mirror" in reason
    assert probability < 0.75
    result = register_grids(mirrored(lake.source), lake.target)
    assert (result.verdict, result.reason) == (verdict, reason)


def test_what_agrees_better_in_a_mirror_is_ambiguous(lake):
    evidence, _ = match_evidence(lake.source, lake.target)
    agreement = replace(evidence.best.agreement, agreement=0.9, num_detail=40.0)
    worse = replace(evidence.best, agreement=agreement)
    decoy = replace(worse, agreement=replace(agreement, agreement=1.0))
    exchanged = replace(evidence, best=worse, decoy=decoy, rivals=())
    assert probability_of(exchanged, is_alone=True) > 0.75
    assert lead_over_decoy(exchanged) < 0.0
    assert decide(exchanged, _CONFIG)[0] is Verdict.ACCEPTED  # noise, as far as this goes
    worse = replace(worse, surprise=0.5 * worse.surprise)
    verdict, reason, _ = decide(replace(exchanged, best=worse), _CONFIG)
    assert verdict is Verdict.AMBIGUOUS
    assert "left and right exchanged" in reason


def test_the_right_match_leads_its_mirror_image(lake):
    evidence, _ = match_evidence(lake.source, lake.target)
    assert lead_over_decoy(evidence) > 1.5
    assert decide(evidence, _CONFIG)[0] is Verdict.ACCEPTED


def test_straight_walls_that_agree_as_well_in_a_mirror_are_no_proof(lake):
    evidence, _ = match_evidence(lake.source, lake.target)
    agreement = replace(evidence.best.agreement, num_detail=0.0)
    bare = replace(evidence.best, agreement=agreement)
    volume = evidence.log_volume
    alike = replace(evidence, best=bare, decoy=bare, rivals=(), decoy_log_volume=volume)
    assert probability_of(alike, is_alone=True) > 0.75
    verdict, reason, probability = decide(alike, _CONFIG)
    assert verdict is Verdict.AMBIGUOUS
    assert "hardly more than straight walls agrees" in reason
    assert probability < 0.75
    detailed = replace(evidence, decoy=evidence.best, rivals=())  # a place like its mirror image
    assert decide(detailed, _CONFIG)[0] is Verdict.ACCEPTED
    assert lead_over_decoy(detailed) == pytest.approx(0.0, abs=0.01)  # of volumes all but equal


def test_a_decoy_that_is_no_number_decides_nothing(lake):
    evidence, _ = match_evidence(lake.source, lake.target)
    bad = replace(evidence, decoy=replace(evidence.best, surprise=float("nan")))
    verdict, reason, _ = decide(bad, _CONFIG)
    assert verdict is Verdict.TOO_FEW_FEATURES
    assert "the surprise in a mirror is nan" in reason


def test_a_prior_does_not_make_a_map_in_a_mirror_right(lake):
    """It says where the source lies, and nothing of where it would, seen in a mirror."""
    source = mirrored(lake.source)
    T_found = match_evidence(source, lake.target)[1][0][1]
    evidence, _ = match_evidence(source, lake.target, prior=PriorWindow(T_found, 1.0, 0.2))
    assert evidence.decoy_log_volume > evidence.log_volume + 3.0
    assert probability_of(evidence, is_alone=True) > 0.75
    verdict, reason, _ = decide(evidence, _CONFIG)
    assert verdict is Verdict.AMBIGUOUS
    assert "in a mirror" in reason
    prior = PriorWindow(lake.T_target_source, 1.0, 0.2)
    assert register_grids(lake.source, lake.target, prior=prior).verdict is Verdict.ACCEPTED


def test_maps_of_one_vehicle_are_not_asked_for_a_mirror(lake):
    prior = PriorWindow(lake.T_target_source, 1.0, 0.2)
    config = VehicleMapperConfig().loop.registration
    evidence, _ = match_evidence(lake.source, lake.target, config, prior=prior)
    assert evidence.decoy is None
    assert lead_over_decoy(evidence) == float("inf")
