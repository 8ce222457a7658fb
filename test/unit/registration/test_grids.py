"""Registration of occupancy maps, against planted motions and hopeless cases."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids import register_grids
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.map_pairs import MapPair, make_pair


def _errors(pair: MapPair, T_target_source: SE2) -> tuple[float, float]:
    """Error of the motion at the source's centre [cells] and of the rotation [deg]."""
    assert pair.T_target_source is not None
    center = pair.source.spec.corners().mean(axis=0)
    offset = T_target_source.apply(center) - pair.T_target_source.apply(center)
    _, turn = T_target_source.distance_to(pair.T_target_source)
    return float(np.hypot(*offset)) / pair.source.spec.resolution_m, math.degrees(turn)


@pytest.mark.parametrize("kind", ["office", "harbour", "lake"])
def test_planted_motion_is_recovered(kind):
    pair = make_pair(kind, 0.7, "noisy", 11)
    result = register_grids(pair.source, pair.target)
    cells, degrees = _errors(pair, result.T_target_source)
    assert result.verdict is Verdict.ACCEPTED, result.reason
    assert result.is_certified
    assert cells < 2.0
    assert degrees < 1.0


def test_different_places_are_refused():
    pair = make_pair("harbour", 0.5, "clean", 3, is_matching=False)
    assert not register_grids(pair.source, pair.target).is_accepted


@pytest.mark.parametrize(
    "values",
    [
        np.full((50, 60), -1, np.int8),
        np.full((50, 60), 100, np.int8),
        np.zeros((50, 60), np.int8),
        np.full((1, 1), 100, np.int8),
    ],
)
def test_hopeless_maps_get_a_sentence(values):
    spec = GridSpec(0.05, *values.shape)
    other = make_pair("harbour", 0.5, "clean", 3).target
    for source, target in (
        (OccupancyMap(spec, values), other),
        (other, OccupancyMap(spec, values)),
    ):
        result = register_grids(source, target)
        assert result.verdict is Verdict.TOO_FEW_FEATURES
        assert "map" in result.reason
