"""Pairs of maps with known answers: the answer is right, and the damage is as asked."""

import math

import cv2
import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN
from uw_dslam_ros2.sim.maps.floor_plans import PLACE_KINDS, make_place
from uw_dslam_ros2.sim.maps.pairs import MapNoise, damage, make_pair, observe

pytestmark = pytest.mark.kernels


def _near_share(pair, T_target_source) -> float:
    """Share of the source's walls inside the target's window that lie on a wall, by two cells."""
    source, target = pair.source, pair.target
    walls = source.spec.centers_of(np.argwhere(source.values == OCCUPIED))
    cells = target.spec.cells_of(T_target_source.apply(walls))
    cells = cells[target.spec.contains(cells)]
    near = cv2.dilate((target.values == OCCUPIED).astype(np.uint8), np.ones((5, 5), np.uint8))
    return float(near[cells[:, 0], cells[:, 1]].mean())


@pytest.mark.parametrize("kind", PLACE_KINDS)
def test_every_place_is_random_closed_and_neither_full_nor_empty(kind):
    first, again, other = (
        make_place(kind, 200, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first[0].all()
    assert first[:, -1].all()
    assert 0.01 < first.mean() < 0.95


@pytest.mark.parametrize("kind", ["corridors", "oblique", "hall", "cellular", "harbour", "basin"])
def test_the_answer_lays_walls_on_walls(kind):
    pair = make_pair(kind, 0.6, "clean", 21, size_cells=160)
    assert _near_share(pair, pair.T_target_source) > 0.97


def test_same_arguments_give_the_same_pair_and_another_seed_another():
    first, again, other = (make_pair("hall", 0.5, "hard", s, size_cells=120) for s in (3, 3, 4))
    assert np.array_equal(first.source.values, again.source.values)
    assert first.T_target_source == again.T_target_source
    assert not np.array_equal(first.source.values, other.source.values)


@pytest.mark.parametrize("overlap", [0.2, 0.5, 0.8])
def test_windows_share_the_asked_part_of_their_area(overlap):
    pair = make_pair("office", overlap, "clean", 5, size_cells=120)
    centers = pair.source.spec.centers_of(np.argwhere(np.ones(pair.source.spec.shape, bool)))
    inside = pair.target.spec.contains(
        pair.target.spec.cells_of(pair.T_target_source.apply(centers))
    )
    assert inside.mean() == pytest.approx(overlap, abs=0.03)


def test_pairs_of_two_places_and_aliases_have_no_answer():
    assert (
        make_pair("lake", 0.5, "clean", 1, size_cells=120, is_matching=False).T_target_source
        is None
    )
    alias = make_pair("basin", 0.7, "clean", 1, size_cells=120, is_alias=True)
    assert alias.T_target_source is None
    assert alias.is_ambiguous


def test_the_windows_of_a_twin_look_alike():
    """A half turn about the basin's middle lays one end on the other."""
    plain = make_pair("basin", 0.7, "clean", 2, size_cells=120)
    alias = make_pair("basin", 0.7, "clean", 2, size_cells=120, is_alias=True)
    is_wall = [m.values == OCCUPIED for m in (plain.target, alias.target)]
    near = cv2.dilate(is_wall[0].astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert near[is_wall[1]].mean() > 0.9


def test_a_symmetric_place_is_the_same_after_a_half_turn():
    for kind in ("symmetric", "basin"):
        place = make_place(kind, 200, np.random.default_rng(7))
        assert np.array_equal(place, np.rot90(place, 2))


def test_damage_is_as_asked():
    rng = np.random.default_rng(0)
    values = np.full((300, 300), FREE, np.int8)
    values[100:200, 100:200] = OCCUPIED
    wiped = damage(values, MapNoise(wiped=0.35), rng)
    assert (wiped == OCCUPIED).sum() == pytest.approx(0.65 * 10_000, rel=0.03)
    speckled = damage(values, MapNoise(speckle=0.03), rng)
    # Every third speck shows what was there before.
    assert (speckled != values).mean() == pytest.approx(0.03 * 2 / 3, rel=0.1)
    assert np.array_equal(damage(values, MapNoise(), rng), values)


def test_a_bend_moves_no_cell_farther_than_asked():
    rng = np.random.default_rng(1)
    values = np.full((400, 400), FREE, np.int8)
    values[200] = OCCUPIED
    rows = np.nonzero(damage(values, MapNoise(bend_cells=3.0), rng) == OCCUPIED)[0]
    assert np.abs(rows - 200).max() <= 3
    assert np.abs(rows - 200).max() >= 1


def test_what_lies_behind_a_wall_stays_unknown():
    solid = np.zeros((80, 80), bool)
    solid[:, 40:43] = True
    solid[:2], solid[-2:], solid[:, :2], solid[:, -2:] = True, True, True, True
    solid[:, 43:] = True  # the looks are taken on the left side only
    seen = observe(solid, np.random.default_rng(2), num_views=20, range_cells=200.0)
    assert (seen[:, 44:] == UNKNOWN).all()
    assert (seen[10:70, 40] == OCCUPIED).mean() > 0.9
    assert (seen[10:70, 10:35] == FREE).mean() > 0.95


def test_wrong_arguments_are_named():
    with pytest.raises(InvalidInputError, match="ocean"):
        make_pair("ocean", 0.5, "clean", 0)
    with pytest.raises(InvalidInputError, match="loud"):
        make_pair("lake", 0.5, "loud", 0)
    with pytest.raises(InvalidInputError, match="basin"):
        make_pair("lake", 0.5, "clean", 0, is_alias=True)
    with pytest.raises(InvalidInputError, match="wiped"):
        MapNoise(wiped=1.5)
    assert math.isfinite(MapNoise().bend_cells)
