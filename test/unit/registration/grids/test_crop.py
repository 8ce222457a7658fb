"""Neither what is outside of the known decides on a match, nor which way the rows run."""

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.crop import crop_to_known, turn_to_own_axes
from uw_dslam_ros2.core.registration.grids.register import register_grids
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import make_pair
from uw_dslam_ros2.sim.maps.variants import turned


def _on_canvas(occupancy: OccupancyMap, left: int, below: int, side: int) -> OccupancyMap:
    """The map on a larger square of unknown cells, in the same frame."""
    spec = occupancy.spec
    values = np.full((side, side), -1, np.int8)
    rows, cols = spec.shape
    values[below : below + rows, left : left + cols] = occupancy.values
    corner = SE2(-left * spec.resolution_m, -below * spec.resolution_m)
    return OccupancyMap(
        GridSpec(spec.resolution_m, side, side, spec.T_frame_grid @ corner), values
    )


def test_a_crop_keeps_each_known_cell_where_it_lies():
    values = np.full((7, 9), -1, np.int8)
    values[2, 3:6], values[4, 4] = 100, 0
    whole = OccupancyMap(GridSpec(0.5, 7, 9, SE2(10.0, -3.0, 0.7)), values)
    part = crop_to_known(whole)
    assert part.spec.shape == (3, 3)
    np.testing.assert_array_equal(part.values, [[100] * 3, [-1] * 3, [-1, 0, -1]])
    np.testing.assert_allclose(
        part.spec.centers_of(np.argwhere(part.known)),
        whole.spec.centers_of(np.argwhere(whole.known)),
    )
    assert crop_to_known(part) is part


def test_specks_far_away_are_cut_and_those_inside_stay():
    values = np.full((300, 400), -1, np.int8)
    values[100:200, 150:290] = 0
    values[120, 170:176] = 100
    values[5, 3], values[290:293, 380] = 100, 0
    part = crop_to_known(OccupancyMap(GridSpec(0.1, 300, 400), values))
    assert part.spec.shape == (100, 140)
    assert (part.values == 100).sum() == 6


def test_a_map_of_nothing_stays():
    nothing = OccupancyMap(GridSpec(0.1, 20, 30), np.full((20, 30), -1, np.int8))
    assert crop_to_known(nothing) is nothing


@pytest.mark.parametrize("is_matching", [True, False])
def test_a_canvas_changes_neither_verdict_nor_motion(is_matching):
    """The lattice once lay over the canvas: with nine wall points left, any pose was certain."""
    pair = make_pair("office", 0.5, "noisy", 7001, size_cells=160, is_matching=is_matching)
    plain = register_grids(pair.source, pair.target)
    large = register_grids(
        _on_canvas(pair.source, 803, 17, 1500), _on_canvas(pair.target, 0, 1400, 1600)
    )
    assert (large.verdict, large.num_boxes) == (plain.verdict, plain.num_boxes)
    assert large.probability == pytest.approx(plain.probability, abs=1e-6)
    distance_m, angle_rad = large.T_target_source.distance_to(plain.T_target_source)
    assert distance_m < 1e-6
    assert angle_rad < 1e-6
    assert plain.is_accepted == is_matching


def test_all_quarter_turns_of_a_map_are_told_one_way():
    values = np.full((3, 5), -1, np.int8)
    values[0, 1], values[0, 2], values[2, 1] = 100, 0, 0
    occupancy = OccupancyMap(GridSpec(0.5, 3, 5, SE2(1.0, 2.0, 0.3)), values)
    told = turn_to_own_axes(occupancy)
    for value in (0, 100):
        np.testing.assert_allclose(
            np.sort(told.spec.centers_of(np.argwhere(told.values == value)), axis=0),
            np.sort(occupancy.spec.centers_of(np.argwhere(values == value)), axis=0),
        )
    for _ in range(4):
        occupancy = turned(occupancy)
        again = turn_to_own_axes(occupancy)
        np.testing.assert_array_equal(again.values, told.values)
        np.testing.assert_allclose(again.spec.corners(), told.spec.corners())


def test_a_map_without_a_side_stays_as_it_is():
    values = np.zeros((5, 5), np.int8)
    values[2, 1:4] = 100  # known everywhere, walls about the middle
    occupancy = OccupancyMap(GridSpec(0.5, 5, 5), values)
    assert turn_to_own_axes(occupancy) is occupancy


@pytest.mark.parametrize("kind", ["cave", "corridors"])
def test_a_quarter_turn_changes_no_answer(kind):
    pair = make_pair(kind, 0.5, "noisy", 7003, size_cells=130)
    plain = register_grids(pair.source, pair.target)
    for source, target in (
        (turned(pair.source), pair.target),
        (turned(turned(turned(pair.source))), turned(pair.target)),
    ):
        again = register_grids(source, target)
        assert again.verdict is plain.verdict
        assert again.probability == pytest.approx(plain.probability, abs=1e-6)
        np.testing.assert_allclose(again.covariance, plain.covariance, atol=1e-9)
        distance_m, angle_rad = again.T_target_source.distance_to(plain.T_target_source)
        assert distance_m < 1e-6
        assert angle_rad < 1e-6
