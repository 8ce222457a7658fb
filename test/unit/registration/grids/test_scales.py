"""Maps that were made apart are bent against each other: on which cells they are compared."""

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids import preparation
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.probability import probability_of
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.sim.map_pairs import MapNoise, MapPair, damage, is_right, make_pair


def _bent(occupancy: OccupancyMap, bend_cells: float, seed: int) -> OccupancyMap:
    """The map on cells a third as large, bent by so many of them."""
    values = np.kron(occupancy.values, np.ones((3, 3), np.int8))
    noise = MapNoise(moved=0.2, bend_cells=bend_cells)
    values = damage(values, noise, np.random.default_rng(seed))
    spec = occupancy.spec
    return OccupancyMap(GridSpec(spec.resolution_m / 3, *values.shape, spec.T_frame_grid), values)


def _judged(pair: MapPair, bend_cells: float) -> tuple[float, float]:
    """Probability that the best pose is right, and on which cells it was judged [m]."""
    source, target = _bent(pair.source, bend_cells, 1), _bent(pair.target, bend_cells, 2)
    evidence, poses = match_evidence(source, target)
    assert is_right(pair, poses[0][1])
    return probability_of(evidence), evidence.cell_m


@pytest.mark.parametrize("place", [("corridors", 0.5, 2), ("office", 0.7, 2)])
def test_bent_maps_are_judged_on_the_cells_on_which_they_agree(place, monkeypatch):
    kind, overlap, seed = place
    pair = make_pair(kind, overlap, "clean", seed, size_cells=140)
    finest_m = pair.source.spec.resolution_m / 3
    straight, cell_m = _judged(pair, 1.0)
    assert cell_m == pytest.approx(finest_m)
    bent, cell_m = _judged(pair, 9.0)
    assert cell_m > 1.5 * finest_m
    monkeypatch.setattr(preparation, "_NUM_SCALES", 1)
    on_finest, cell_m = _judged(pair, 9.0)
    assert cell_m == pytest.approx(finest_m)
    assert bent / (1.0 - bent) > 2.0 * on_finest / (1.0 - on_finest)  # in odds
    assert bent - 0.1 < straight
    assert _judged(pair, 1.0)[0] == straight  # nothing is gained where nothing is bent


def test_cells_are_not_doubled_until_everything_is_near_a_wall():
    pair = make_pair("office", 0.7, "clean", 2, size_cells=140)
    values = pair.source.values.copy()
    values[:, ::12] = np.where(values[:, ::12] >= 0, 100, values[:, ::12])
    narrow = OccupancyMap(pair.source.spec, values)
    _, scales = preparation.prepare_maps(narrow, pair.target, GridRegistrationConfig())
    assert len(scales) == 1
    _, scales = preparation.prepare_maps(pair.source, pair.target, GridRegistrationConfig())
    sizes = [side.cells.resolution_m for sides in scales for side in sides]
    assert sizes == pytest.approx([0.05, 0.05, 0.1, 0.1, 0.2, 0.2][: len(sizes)])
    assert 1 < len(scales) <= 4
