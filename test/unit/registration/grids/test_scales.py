"""Maps that were made apart are bent against each other: on which cells they are compared."""

import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_filter import clean_cells, coarsen, split
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids import preparation
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap, measure_agreement
from uw_dslam_ros2.core.registration.grids.judging.probability import probability_of
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapNoise, MapPair, damage, is_right, make_pair
from uw_dslam_ros2.sim.maps.variants import VARIANTS


def _bent(occupancy: OccupancyMap, bend_cells: float, seed: int) -> OccupancyMap:
    """The map on cells a third as large, bent by so many of them."""
    values = np.kron(occupancy.values, np.ones((3, 3), np.int8))
    noise = MapNoise(moved=0.2, bend_cells=bend_cells)
    values = damage(values, noise, np.random.default_rng(seed))
    spec = occupancy.spec
    return OccupancyMap(GridSpec(spec.resolution_m / 3, *values.shape, spec.T_frame_grid), values)


def _judged(pair: MapPair, bend_cells: float) -> tuple[float, float]:
    """How convincing the best pose is, and on which cells it was judged [m]."""
    source, target = _bent(pair.source, bend_cells, 1), _bent(pair.target, bend_cells, 2)
    evidence, poses = match_evidence(source, target)
    assert is_right(pair, poses[0][1])
    return probability_of(evidence, is_alone=True), evidence.cell_m


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


def _cells_m(source: OccupancyMap, target: OccupancyMap) -> list[float]:
    """Sides of the cells that two maps are compared on."""
    _, scales = preparation.prepare_maps(source, target, GridRegistrationConfig())
    assert all(a.cells.resolution_m == b.cells.resolution_m for a, b in scales)
    return [a.cells.resolution_m for a, _ in scales]


def test_cells_are_not_doubled_until_everything_is_near_a_wall():
    pair = make_pair("office", 0.7, "clean", 2, size_cells=140)
    values = pair.source.values.copy()
    values[:, ::12] = np.where(values[:, ::12] >= 0, 100, values[:, ::12])
    narrow = OccupancyMap(pair.source.spec, values)
    assert _cells_m(narrow, pair.target) == pytest.approx([0.025, 0.05])
    sizes = _cells_m(pair.source, pair.target)
    assert sizes == pytest.approx([0.05, 0.1, 0.2, 0.4][: len(sizes)])
    assert 1 < len(sizes) <= 4


@pytest.mark.parametrize("place", [("office", 0.7, 2), ("corridors", 0.7, 4)])
def test_maps_of_large_cells_are_judged_on_smaller_ones(place):
    """On cells of a room's size, all that is free is near a wall, and tells nothing."""
    kind, overlap, seed = place
    pair = make_pair(kind, overlap, "clean", seed, size_cells=260)
    coarse = VARIANTS["cells twice as large"](VARIANTS["cells twice as large"](pair))
    evidence, poses = match_evidence(coarse.source, coarse.target)
    assert evidence.cell_m == pytest.approx(0.5 * coarse.source.spec.resolution_m)
    assert is_right(pair, poses[0][1])
    fine, _ = match_evidence(pair.source, pair.target)
    assert probability_of(evidence) > 0.75
    assert probability_of(fine) > 0.75


def test_what_is_said_on_half_cells_is_no_more_than_the_maps_hold():
    """A thick wall of half cells counts by its length, and its thickness is no detail."""
    values = np.zeros((80, 80), np.int8)
    values[20:24, 10:70] = values[10:70, 20:25] = 100
    cells = clean_cells(OccupancyMap(GridSpec(0.1, 80, 80), values))
    own, halved = WallMap(cells), WallMap(split(cells), is_split=True)
    T = SE2(1.0, 0.0, 0.0)  # cells
    told, again = (
        measure_agreement(walls, walls, SE2(size * T.x, size * T.y, T.yaw))
        for walls, size in ((own, 1.0), (halved, 2.0))
    )
    assert again.num_walls == pytest.approx(2 * told.num_walls, abs=2)
    assert told.num_detail < 5.0
    assert again.num_detail < 5.0
    assert again.agreement == told.agreement == 1.0
    assert again.wall_share < told.wall_share  # what they are for


def test_split_cells_hold_what_the_whole_ones_held(rng):
    values = rng.choice([-1, 0, 100], (12, 17)).astype(np.int8)
    values[5, 2:12] = 100
    cells = clean_cells(OccupancyMap(GridSpec(0.2, 12, 17), values))
    parts = split(cells)
    assert parts.resolution_m == 0.1
    again = coarsen(parts, 0.2)
    for name in ("free", "known"):
        np.testing.assert_allclose(getattr(again, name), getattr(cells, name))
    np.testing.assert_array_equal(again.wall > 0.25, cells.wall > 0.25)
    assert cells.wall.any()
    np.testing.assert_allclose(again.col[cells.wall > 0], cells.col[cells.wall > 0])
    np.testing.assert_allclose(again.row[cells.wall > 0], cells.row[cells.wall > 0])
