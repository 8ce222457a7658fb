"""Drawing and summing, against literal numbers and against drawing anew."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uw_dslam_ros2.core.grid import UNSEEN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.mosaic import Mosaic, fuse_maps
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import Window

pytestmark = pytest.mark.kernels

LATTICE = GridSpec(1.0, 1, 1)
HAND_MADE = OccupancyMap(
    GridSpec(1.0, 2, 3, SE2(-1.0, -1.0)), np.array([[0, 100, -1], [0, 0, 100]], dtype=np.int8)
)


def drawn(occupancy, T_frame_map):
    """A map on the lattice: its lowest corner [x, y], and 1 wall, -1 free, 0 unseen."""
    fused = fuse_maps(LATTICE, [(occupancy, T_frame_map)], 8.0)
    corner = fused.spec.T_frame_grid
    return (corner.x, corner.y), np.where(fused.known, np.sign(fused.values - 50), 0)


def test_a_hand_written_map_at_rest_is_copied():
    corner, cells = drawn(HAND_MADE, SE2())
    assert corner == (-1.0, -1.0)
    np.testing.assert_array_equal(cells, [[-1, 1, 0], [-1, -1, 1]])


def test_a_quarter_turn_turns_columns_into_rows():
    # +x of the map becomes +y of the lattice: the second row (y in [0, 1)) lands at x in [-1, 0).
    corner, cells = drawn(HAND_MADE, SE2(0.0, 0.0, math.pi / 2))
    assert corner == (-1.0, -1.0)
    np.testing.assert_array_equal(cells, [[-1, -1], [-1, 1], [1, 0]])


def test_a_shift_by_whole_cells_moves_the_window_alone():
    at_rest = drawn(HAND_MADE, SE2())[1]
    corner, cells = drawn(HAND_MADE, SE2(5.0, -3.0))
    assert corner == (4.0, -4.0)
    np.testing.assert_array_equal(cells, at_rest)


def test_a_coarser_lattice_keeps_thin_walls():
    values = np.zeros((8, 8), dtype=np.int8)
    values[:, 5] = 100
    fine = OccupancyMap(GridSpec(0.25, 8, 8), values)
    np.testing.assert_array_equal(drawn(fine, SE2())[1], [[-1, 1], [-1, 1]])


def test_the_lattices_own_place_and_turn_count():
    lattice = GridSpec(1.0, 1, 1, SE2(0.0, 0.0, math.pi / 2))
    fused = fuse_maps(lattice, [(HAND_MADE, SE2(0.0, 0.0, math.pi / 2))], 8.0)
    np.testing.assert_array_equal(fused.known, HAND_MADE.known)
    expected = SE2(0.0, 0.0, math.pi / 2) @ HAND_MADE.spec.T_frame_grid
    assert fused.spec.T_frame_grid.distance_to(expected) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_unknown_stays_unknown_and_contradictions_are_counted():
    mosaic = Mosaic(LATTICE)
    for key, value in (("a", 100), ("b", 0), ("c", 100)):
        occupancy = OccupancyMap(GridSpec(1.0, 1, 2), np.array([[value, -1]], dtype=np.int8))
        mosaic.put(key, 0, occupancy, SE2())
    # Two against one: once the half percent from certainty that a map's 100 stands for.
    np.testing.assert_array_equal(mosaic.occupancy(8.0).values, [[99]])
    np.testing.assert_array_equal(mosaic.occupancy(1.0).values, [[73]])
    np.testing.assert_array_equal(mosaic.contradictions().dense(), [[1]])
    owners, sets = mosaic.contributor_sets()
    assert [sets[k] for k in owners.dense().ravel()] == [{"a", "b", "c"}]


def random_map(rng):
    shape = tuple(int(n) for n in rng.integers(2, 9, 2))
    values = rng.choice([-1, 0, 30, 80, 100], size=shape).astype(np.int8)
    return OccupancyMap(GridSpec(1.0, *shape, SE2(*rng.uniform(-3, 3, 2))), values)


def content(mosaic):
    """Everything that a mosaic says, as bytes."""
    fused = mosaic.occupancy(8.0)
    if fused is None:
        return None
    owners, sets = mosaic.contributor_sets()
    cells = mosaic.contradictions().dense(), owners.dense()
    arrays = fused.values.tobytes(), *(values.tobytes() for values in cells)
    return fused.spec, arrays, sets


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), order=st.permutations(range(6)))
def test_any_history_ends_in_the_bytes_of_drawing_anew(seed, order):
    """Put, move, remove and put back in any order: the sum has no memory."""
    rng = np.random.default_rng(seed)
    maps = [random_map(rng) for _ in range(6)]
    poses = [SE2.from_array(rng.uniform(-300, 300, 3)) for _ in range(6)]
    mosaic = Mosaic(LATTICE)
    for key in order:
        mosaic.put(key, 0, maps[key], poses[key - 1])
        mosaic.put(key, 1, maps[key], poses[key])
        if key % 2:
            mosaic.remove(key)
    for key in (1, 3, 5):
        mosaic.put(key, 1, maps[key], poses[key])
    fresh = Mosaic(LATTICE)
    for key in range(6):
        fresh.put(key, 1, maps[key], poses[key])
    assert content(mosaic) == content(fresh)
    for key in range(6):
        mosaic.remove(key)
    assert content(mosaic) is None
    assert mosaic._tiles == {}


def test_a_map_is_the_same_wherever_the_edges_of_tiles_run():
    """Against one cell at a time, on a map that lies across several tiles."""
    rng = np.random.default_rng(1)
    values = rng.choice([-1, 10, 90], size=(300, 350)).astype(np.int8)
    occupancy, T = OccupancyMap(GridSpec(1.0, 300, 350), values), SE2(-170.3, 40.8, 0.4)
    fused = fuse_maps(LATTICE, [(occupancy, T)], 8.0)
    cells = np.argwhere(np.ones(fused.values.shape, dtype=bool))
    looked = occupancy.spec.cells_of(T.inverse().apply(fused.spec.centers_of(cells)))
    inside = occupancy.spec.contains(looked)
    expected = np.full(len(cells), -1)
    expected[inside] = values[looked[inside, 0], looked[inside, 1]]
    np.testing.assert_array_equal(fused.values.ravel(), expected)


def test_what_changed_is_the_rectangle_that_was_seen_before_or_after():
    mosaic = Mosaic(LATTICE)
    mosaic.put("a", 0, HAND_MADE, SE2())
    assert mosaic.take_changed() == Window(-1, -1, 1, 2)
    assert mosaic.take_changed() is None
    mosaic.put("a", 1, HAND_MADE, SE2(10.0, 300.0))
    assert mosaic.take_changed() == Window(-1, -1, 301, 12)
    assert mosaic.window() == Window(299, 9, 301, 12)


def test_maps_that_are_far_apart_cost_no_more_than_maps_that_are_near():
    mosaic = Mosaic(LATTICE)
    for key in range(3):
        mosaic.put(key, 0, HAND_MADE, SE2(1e7 * key, -1e7 * key))
    assert len(mosaic._tiles) <= 12
    assert mosaic.window().shape == (20_000_002, 20_000_003)


def test_a_map_of_nothing_leaves_nothing():
    nothing = OccupancyMap(GridSpec(1.0, 2, 2), np.full((2, 2), -1, dtype=np.int8))
    assert fuse_maps(LATTICE, [(nothing, SE2())], 8.0) is None
    mosaic = Mosaic(LATTICE)
    mosaic.put("a", 0, nothing, SE2())
    assert mosaic.occupancy(8.0) is None
    assert mosaic.contradictions() is None
    assert mosaic.contributor_sets() is None
    assert mosaic.window() is None


def test_percent_and_units_are_each_others_inverse_but_at_certainty():
    values = np.arange(-1, 101, dtype=np.int8)[None]
    occupancy = OccupancyMap(GridSpec(1.0, 1, 102), values)
    assert occupancy.units()[0, 0] == UNSEEN
    assert occupancy.units()[0, 51] == 0
    assert occupancy.units()[0, 81] == 1386  # log(0.8 / 0.2)
    again = fuse_maps(LATTICE, [(occupancy, SE2())], 8.0).values[0]
    np.testing.assert_array_equal(again[1:-1], values[0, 2:-1])
    assert (again[0], again[-1]) == (1, 99)
