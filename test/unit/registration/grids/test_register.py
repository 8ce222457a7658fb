"""Registration of occupancy maps, against planted motions and hopeless cases."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, Progress, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair, make_pair


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
    assert cells < 0.5  # 0.19 cells and 0.09 degrees were seen
    assert degrees < 0.3


def _coarser(occupancy: OccupancyMap) -> OccupancyMap:
    """The map with cells twice as large; any wall inside makes a wall."""
    rows, cols = (size // 2 for size in occupancy.spec.shape)
    blocks = occupancy.values.reshape(rows, 2, cols, 2)
    values = np.where((blocks == 0).any(axis=(1, 3)), 0, -1)
    values = np.where((blocks == 100).any(axis=(1, 3)), 100, values).astype(np.int8)
    spec = occupancy.spec
    return OccupancyMap(GridSpec(2 * spec.resolution_m, rows, cols, spec.T_frame_grid), values)


def _framed(occupancy: OccupancyMap, T_new_old: SE2) -> OccupancyMap:
    spec = occupancy.spec
    moved = GridSpec(spec.resolution_m, *spec.shape, T_new_old @ spec.T_frame_grid)
    return OccupancyMap(moved, occupancy.values)


@pytest.fixture(scope="module")
def harbour() -> MapPair:
    return make_pair("harbour", 0.7, "noisy", 4, size_cells=180)


@pytest.mark.parametrize("sides", [(True, False), (False, True)])
def test_unequal_resolutions_give_the_same_motion(harbour, sides):
    source = _coarser(harbour.source) if sides[0] else harbour.source
    target = _coarser(harbour.target) if sides[1] else harbour.target
    result = register_grids(source, target)
    cells, degrees = _errors(harbour, result.T_target_source)
    assert result.is_accepted, result.reason
    assert cells < 3.0
    assert degrees < 1.0


def _enlarged(occupancy: OccupancyMap, side: int) -> OccupancyMap:
    spec = occupancy.spec
    values = np.repeat(np.repeat(occupancy.values, side, axis=0), side, axis=1)
    fine = GridSpec(spec.resolution_m / side, *values.shape, spec.T_frame_grid)
    return OccupancyMap(fine, values)


@pytest.mark.parametrize("sides", [(4, 4), (5, 1), (1, 8)])
def test_enlarged_cells_change_nothing(harbour, sides):
    plain = register_grids(harbour.source, harbour.target)
    large = register_grids(
        _enlarged(harbour.source, sides[0]), _enlarged(harbour.target, sides[1])
    )
    assert (large.verdict, large.num_boxes) == (plain.verdict, plain.num_boxes)
    distance_m, angle_rad = large.T_target_source.distance_to(plain.T_target_source)
    assert distance_m < 1e-6
    assert angle_rad < 1e-6


def test_rotated_origins_only_change_the_frames(harbour):
    T_new_source, T_new_target = SE2(3.0, 4.0, 1.1), SE2(-7.0, 2.0, -2.0)
    plain = register_grids(harbour.source, harbour.target)
    framed = register_grids(
        _framed(harbour.source, T_new_source), _framed(harbour.target, T_new_target)
    )
    expected = T_new_target @ plain.T_target_source @ T_new_source.inverse()
    distance_m, turn = expected.distance_to(framed.T_target_source)
    assert framed.is_accepted
    assert distance_m < 1e-6
    assert turn < 1e-8


def test_the_same_input_gives_the_same_answer(harbour):
    results = [register_grids(harbour.source, harbour.target) for _ in range(2)]
    assert results[0].T_target_source == results[1].T_target_source
    assert results[0].num_boxes == results[1].num_boxes


def test_a_prior_finds_the_same_and_a_wrong_one_does_not(harbour):
    assert harbour.T_target_source is not None
    truth = harbour.T_target_source
    near = PriorWindow(SE2(truth.x + 0.5, truth.y - 0.5, truth.yaw + 0.1), 2.0, 0.3)
    result = register_grids(harbour.source, harbour.target, prior=near)
    assert result.is_accepted, result.reason
    assert _errors(harbour, result.T_target_source)[0] < 0.5
    far = PriorWindow(SE2(truth.x, truth.y, truth.yaw + 2.0), 2.0, 0.3)
    assert not register_grids(harbour.source, harbour.target, prior=far).is_accepted


def test_a_cancel_stops_the_search_and_progress_brackets(harbour):
    seen: list[Progress] = []
    result = register_grids(harbour.source, harbour.target, progress=seen.append)
    assert seen
    assert all(p.lower_bound <= p.upper_bound for p in seen)
    assert seen[-1].upper_bound >= result.lower_bound
    stopped = register_grids(harbour.source, harbour.target, is_cancelled=lambda: True)
    assert stopped.verdict is Verdict.BUDGET_EXHAUSTED
    assert not stopped.is_certified


def test_a_straight_wall_is_refused_and_its_covariance_says_so():
    values = np.full((160, 160), -1, np.int8)
    values[80:] = 0
    values[80:82] = 100
    wall = OccupancyMap(GridSpec(0.05, 160, 160), values)
    result = register_grids(wall, wall)
    assert result.verdict is Verdict.AMBIGUOUS, result.reason
    assert np.sqrt(result.covariance[0, 0]) > 1.0


def test_a_symmetric_room_is_ambiguous():
    values = np.full((160, 220), -1, np.int8)
    values[20:140, 20:200] = 100
    values[22:138, 22:198] = 0
    room = OccupancyMap(GridSpec(0.05, 160, 220), values)
    result = register_grids(room, room)
    assert result.verdict is Verdict.AMBIGUOUS, result.reason
    assert max(r.score for r in result.rivals) > 0.95


def test_the_papers_points_stay_selectable(harbour):
    config = GridRegistrationConfig(method="paper", max_points=60)
    result = register_grids(harbour.source, harbour.target, config)
    assert 0 < result.num_source_points <= 60
    assert 0.0 <= result.overlap <= 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_false_accept", 0.1),
        ("min_overlap", 0.3),
        ("is_proof_required", True),
        ("free_penalty", 0.1),
    ],
)
def test_the_papers_points_refuse_what_they_do_not_know(name, value):
    with pytest.raises(ConfigError, match=f"{name} is {value}, expected .*method paper"):
        GridRegistrationConfig(method="paper", **{name: value})
    assert getattr(GridRegistrationConfig(**{name: value}), name) == value
    GridRegistrationConfig(method="paper", features="walls", gap=0.2, max_boxes=5000)


@pytest.mark.parametrize("method", ["signed", "paper"])
def test_a_map_beyond_the_limit_is_refused_by_name(harbour, method):
    config = GridRegistrationConfig(method=method, max_side_cells=150)
    result = register_grids(harbour.source, harbour.target, config)
    assert result.verdict is Verdict.BUDGET_EXHAUSTED
    assert "180 x 180 cells, expected at most 150" in result.reason
    assert result.T_target_source is None


def test_different_places_are_refused():
    pair = make_pair("harbour", 0.5, "clean", 3, is_matching=False)
    assert not register_grids(pair.source, pair.target).is_accepted


def test_different_places_on_large_canvases_are_refused():
    """A lattice laid over the canvas leaves little of the walls, and chance has no peak."""
    pair = make_pair("cave", 0.7, "clean", 4, is_matching=False)
    maps = []
    for grid, (row, col) in ((pair.source, (1900, 1333)), (pair.target, (2000, 2000))):
        values = np.full((4000, 4000), -1, np.int8)
        rows, cols = grid.spec.shape
        values[row : row + rows, col : col + cols] = grid.values
        maps.append(OccupancyMap(GridSpec(grid.spec.resolution_m, 4000, 4000), values))
    result = register_grids(*maps)
    assert not result.is_accepted, result.reason
    assert np.isfinite(result.probability)


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
        assert result.T_target_source is None
        assert "map" in result.reason


def test_walls_without_any_free_cell_get_an_answer(harbour):
    maps = [
        OccupancyMap(grid.spec, np.where(grid.values > 50, grid.values, -1).astype(np.int8))
        for grid in (harbour.source, harbour.target)
    ]
    assert np.isfinite(register_grids(*maps).probability)


def test_an_accepted_match_says_where_its_proof_is_open(harbour):
    config = GridRegistrationConfig(max_boxes=1000, gap=0.001)
    result = register_grids(harbour.source, harbour.target, config)
    assert result.verdict is Verdict.ACCEPTED
    assert not result.is_certified
    assert result.gap > config.gap
    assert f"with a gap of {result.gap:.0%}" in result.reason
    strict = GridRegistrationConfig(max_boxes=1000, gap=0.001, is_proof_required=True)
    refused = register_grids(harbour.source, harbour.target, strict)
    assert refused.verdict is Verdict.BUDGET_EXHAUSTED
