"""Drawing and summing, against literal numbers and against drawing anew."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.fusion import Mosaic, fuse_maps, render_patch, snap_pose
from uw_dslam_ros2.core.se2 import SE2

LATTICE = GridSpec(1.0, 1, 1)
HAND_MADE = OccupancyMap(
    GridSpec(1.0, 2, 3, SE2(-1.0, -1.0)), np.array([[0, 100, -1], [0, 0, 100]], dtype=np.int8)
)


def decided(patch):
    """1 wall, -1 free, 0 unseen."""
    return np.where(patch.observed, np.sign(patch.units), 0)


def test_a_hand_written_map_at_rest_is_copied():
    patch = render_patch(LATTICE, HAND_MADE, SE2())
    assert (patch.window.row_0, patch.window.col_0) == (-1, -1)
    np.testing.assert_array_equal(decided(patch), [[-1, 1, 0], [-1, -1, 1]])


def test_a_quarter_turn_turns_columns_into_rows():
    # +x of the map becomes +y of the lattice: the second row (y in [0, 1)) lands at x in [-1, 0).
    patch = render_patch(LATTICE, HAND_MADE, SE2(0.0, 0.0, math.pi / 2))
    assert (patch.window.row_0, patch.window.col_0) == (-1, -1)
    np.testing.assert_array_equal(decided(patch), [[-1, -1], [-1, 1], [1, 0]])


def test_a_shift_by_whole_cells_moves_the_window_alone():
    at_rest = render_patch(LATTICE, HAND_MADE, SE2())
    moved = render_patch(LATTICE, HAND_MADE, SE2(5.0, -3.0))
    assert (moved.window.row_0, moved.window.col_0) == (-4, 4)
    np.testing.assert_array_equal(moved.units, at_rest.units)


def test_a_coarser_lattice_keeps_thin_walls():
    values = np.zeros((8, 8), dtype=np.int8)
    values[:, 5] = 100
    fine = OccupancyMap(GridSpec(0.25, 8, 8), values)
    np.testing.assert_array_equal(decided(render_patch(LATTICE, fine, SE2())), [[-1, 1], [-1, 1]])


def test_unknown_stays_unknown_and_contradictions_are_counted():
    mosaic = Mosaic(LATTICE, 8.0)
    for key, value in (("a", 100), ("b", 0), ("c", 100)):
        values = np.array([[value, -1]], dtype=np.int8)
        occupancy = OccupancyMap(GridSpec(1.0, 1, 2), values)
        mosaic.put(key, 0, render_patch(LATTICE, occupancy, SE2()))
    evidence = mosaic.evidence()
    np.testing.assert_array_equal(evidence.observed, [[True]])
    np.testing.assert_allclose(evidence.log_odds, [[math.log(0.995 / 0.005)]], atol=1e-3)
    np.testing.assert_array_equal(mosaic.contradictions(), [[1]])
    assert sorted(key for key, _ in mosaic.contributors(0, 0)) == ["a", "b", "c"]
    assert mosaic.contributors(0, 1) == []


def random_map(rng):
    shape = tuple(int(n) for n in rng.integers(2, 9, 2))
    values = rng.choice([-1, 0, 30, 80, 100], size=shape).astype(np.int8)
    return OccupancyMap(GridSpec(1.0, *shape, SE2(*rng.uniform(-3, 3, 2))), values)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), order=st.permutations(range(6)))
def test_any_history_ends_in_the_bytes_of_drawing_anew(seed, order):
    """Put, move, remove and put back in any order: the sum has no memory."""
    rng = np.random.default_rng(seed)
    maps = [random_map(rng) for _ in range(6)]
    poses = [SE2.from_array(rng.uniform(-300, 300, 3)) for _ in range(6)]
    mosaic = Mosaic(LATTICE, 8.0)
    for key in order:
        mosaic.put(key, 0, render_patch(LATTICE, maps[key], poses[key - 1]))
        mosaic.put(key, 1, render_patch(LATTICE, maps[key], poses[key]))
        if key % 2:
            mosaic.remove(key)
    for key in (1, 3, 5):
        mosaic.put(key, 1, render_patch(LATTICE, maps[key], poses[key]))
    fresh = Mosaic(LATTICE, 8.0)
    for key in range(6):
        fresh.put(key, 1, render_patch(LATTICE, maps[key], poses[key]))
    for one, other in ((mosaic, fresh),):
        first, second = one.evidence(), other.evidence()
        assert first.spec == second.spec
        assert first.log_odds.tobytes() == second.log_odds.tobytes()
        assert first.observed.tobytes() == second.observed.tobytes()
        assert one.contradictions().tobytes() == other.contradictions().tobytes()


def test_a_map_of_nothing_leaves_nothing():
    nothing = OccupancyMap(GridSpec(1.0, 2, 2), np.full((2, 2), -1, dtype=np.int8))
    assert fuse_maps(LATTICE, [(nothing, SE2())], 8.0) is None
    mosaic = Mosaic(LATTICE, 8.0)
    mosaic.put("a", 0, render_patch(LATTICE, nothing, SE2()))
    assert mosaic.evidence() is None
    assert mosaic.contradictions() is None


@pytest.mark.parametrize("seed", range(20))
def test_snapping_moves_no_point_by_more_than_a_tenth_of_a_cell_each_way(seed):
    rng = np.random.default_rng(seed)
    radius_m, resolution_m = rng.uniform(1.0, 80.0), rng.uniform(0.02, 2.0)
    motion = SE2.from_array(rng.uniform(-200, 200, 3))
    snapped = snap_pose(motion, resolution_m, radius_m)
    rim = radius_m * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=-1)
    moved = np.hypot(*(snapped.apply(rim) - motion.apply(rim)).T)
    assert moved.max() <= 0.13 * resolution_m
    assert snap_pose(snapped, resolution_m, radius_m).distance_to(snapped) == pytest.approx((0, 0))
