"""The last pass: pings drawn at the graph's poses, and trajectories that follow them."""

import dataclasses

import numpy as np
import pytest

from uw_dslam_ros2.cli.reporting.outcome import outcome_of
from uw_dslam_ros2.cli.running.charting import chart_tracks, charted
from uw_dslam_ros2.core.chart import drawing
from uw_dslam_ros2.core.chart.drawing import PingTrack, draw_chart
from uw_dslam_ros2.core.chart.pings import pack_ping
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.metrics import map_sharpness
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections
from uw_dslam_ros2.core.submap import Submap, Track

SECOND = 1_000_000_000
CONFIG = OccupancyConfig(resolution_m=0.1)
WALLS_M = (8.0, 6.0)
"""A corner: a wall across x, and one across y."""
TRACK = Track("auv_1", 0)
STARTS = (SE2(0.0, 0.0, 0.3), SE2(2.0, 0.5, 0.6))


def corner_seen_from(pose, stamp_ns, rng):
    """A fan that looks into the corner."""
    bearings = np.linspace(-0.9, 0.9, 91)
    yaw = pose.yaw + bearings
    with np.errstate(divide="ignore"):
        ways = np.array([(WALLS_M[0] - pose.x) / np.cos(yaw), (WALLS_M[1] - pose.y) / np.sin(yaw)])
    ranges = np.where(ways > 0.0, ways, np.inf).min(axis=0) + rng.normal(0.0, 0.02, 91)
    points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    return Detections(stamp_ns, points, np.ones(91), bearings, ranges, 0.02, 0.03)


@pytest.fixture(scope="module")
def run():
    """Two submaps of one vehicle, the second a little off, and their pings."""
    rng = np.random.default_rng(0)
    queue, pings = MapQueue(), {}
    error = SE2(0.12, -0.1, 0.0)
    for sequence, start in enumerate(STARTS):
        grid, own, before = GrowingGrid(CONFIG), [], None
        stamps = (10 * sequence + np.arange(8)) * SECOND
        path = [SE2(0.25 * i, 0.0, 0.0) for i in range(8)]
        for stamp_ns, T_submap_sonar in zip(stamps, path, strict=True):
            seen = corner_seen_from(start @ T_submap_sonar, int(stamp_ns), rng)
            grid.add(seen, T_submap_sonar)
            before = pack_ping(seen, T_submap_sonar, before)
            own.append(before)
        T_odom_submap = error @ start if sequence else start
        submap = Submap(
            "auv_1", sequence, 0, True, int(stamps[-1]), T_odom_submap, 1e-4 * np.eye(3),
            grid.trimmed().to_occupancy(4.0), np.empty((0, 2)),
            np.array([T.as_array() for T in path]), stamps,
        )  # fmt: skip
        queue.add_submap(submap)
        pings[submap.submap_id] = tuple(own)
    return outcome_of(queue), pings


def test_the_chart_is_sharper_than_the_sum_and_lies_where_it_lay(run):
    outcome, pings = run
    chart = charted(outcome, pings, OccupancyConfig())
    assert chart.global_map.spec.resolution_m == CONFIG.resolution_m
    before, after = map_sharpness(outcome.global_map), map_sharpness(chart.global_map)
    assert after.wall_thickness_cells < before.wall_thickness_cells
    walls = chart.global_map.spec.centers_of(np.argwhere(chart.global_map.values > 50))
    walls = STARTS[0].apply(walls)  # the map's frame is the first submap's
    off = np.minimum(np.abs(walls[:, 0] - WALLS_M[0]), np.abs(walls[:, 1] - WALLS_M[1]))
    assert np.median(off) < 0.12


def test_the_trajectory_moves_with_its_pings(run):
    outcome, pings = run
    before, after = chart_tracks(outcome, pings)
    chart = charted(outcome, pings, OccupancyConfig())
    stamps_ns, poses = chart.vehicles[0].trajectory
    old = outcome.vehicles[0].trajectory[1]
    moved = after[TRACK].T_map_sonar - before[TRACK].T_map_sonar
    moved[:, 2] -= after[TRACK].mounting_rad
    at = np.searchsorted(stamps_ns, before[TRACK].stamps_ns)
    np.testing.assert_allclose((poses - old)[at], moved, atol=1e-9)
    # The two submaps disagreed by 0.16 m; now they are nearer to each other than they were.
    assert np.hypot(*(moved[-1] - moved[0])[:2]) > 0.03


@pytest.mark.parametrize("resolution_m", [0.1, 0.25])
def test_a_wall_takes_one_cell_where_cells_are_large_and_has_no_gap(resolution_m):
    rng = np.random.default_rng(2)
    starts = [STARTS[0] @ SE2(0.25 * i, 0.0, 0.0) for i in range(12)]
    own = [pack_ping(corner_seen_from(T, i, rng), T) for i, T in enumerate(starts)]
    track = PingTrack(own, np.array([T.as_array() for T in starts]))
    chart = draw_chart([track], OccupancyConfig(resolution_m=resolution_m), 8.0)
    walls = chart.spec.centers_of(np.argwhere(chart.values > 50))
    across = walls[np.abs(walls[:, 0] - WALLS_M[0]) < 0.3]
    middle = across[(across[:, 1] > 0.0) & (across[:, 1] < 5.0)]
    _, counts = np.unique(np.floor(middle[:, 1] / resolution_m).astype(int), return_counts=True)
    assert len(counts) == round(5.0 / resolution_m)
    assert counts.mean() < 1.6


def test_without_pings_nothing_changes(run):
    outcome, _ = run
    assert charted(outcome, {}, OccupancyConfig()) is outcome


def test_a_track_has_one_pose_for_each_ping(run):
    _, pings = run
    own = next(iter(pings.values()))
    with pytest.raises(InvalidInputError, match=r"T_map_sonar has shape \(2, 3\)"):
        PingTrack(own, np.zeros((2, 3)))


def test_no_pings_are_no_chart():
    assert draw_chart([], CONFIG, 8.0) is None


@pytest.mark.parametrize("side", [16, 50])
def test_a_chart_drawn_in_blocks_is_the_whole_chart(run, monkeypatch, side):
    _, pings = run
    own = [ping for pings_of_submap in pings.values() for ping in pings_of_submap]
    poses = np.array([(1.5 * k, -0.7 * k, 0.4 * k) for k in range(len(own))])
    whole = GrowingGrid(CONFIG, share_against=drawing.SHARE_AGAINST, face_cells=0.5)
    for ping, pose in zip(own, poses, strict=True):
        whole.add(ping.detections(), SE2.from_array(pose))
    expected = whole.trimmed().to_occupancy(8.0)
    monkeypatch.setattr(drawing, "_BLOCK_SIDE", side)
    chart = draw_chart([PingTrack(own, poses)], CONFIG, 8.0)
    assert chart.spec == expected.spec
    assert np.array_equal(chart.values, expected.values)


def test_a_chart_that_would_be_too_large_is_told_and_the_sum_stays(run, monkeypatch):
    outcome, pings = run
    monkeypatch.setattr(drawing, "MAX_MAP_SIDE", 50)
    told = []
    assert charted(outcome, pings, OccupancyConfig(), told.append) is outcome
    assert [finding.kind for finding in told] == ["no_chart"]
    assert "expected at most 50 a side" in told[0].detail


def test_a_kept_ping_is_the_ping():
    rng = np.random.default_rng(1)
    seen = corner_seen_from(SE2(), 5, rng)
    first = pack_ping(seen, SE2(1.0, 2.0, 0.1))
    again = first.detections()
    np.testing.assert_allclose(again.points, seen.points, atol=1e-5)
    np.testing.assert_allclose(again.free_range_m, seen.free_range_m, atol=1e-5)
    other = pack_ping(dataclasses.replace(seen, bearing_rad=seen.bearing_rad.copy()), SE2(), first)
    assert other.bearing_rad is first.bearing_rad
