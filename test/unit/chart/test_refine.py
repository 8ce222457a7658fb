"""Paths are bent until pings agree on walls, and no further."""

import dataclasses

import numpy as np
import pytest

from uw_dslam_ros2.core.chart.bending import Track
from uw_dslam_ros2.core.chart.reckoning import follows
from uw_dslam_ros2.core.chart.refine import range_scales, refine_tracks
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.se2 import SE2

ROOM_M = (0.0, 0.0, 30.0, 20.0)


def echoes_of_room(pose, rng, num=60, sigma=0.03):
    """Echoes (N, 2) of a fan of 130 degrees in a room with a pillar, in the sonar's frame."""
    x, y, yaw = pose
    bearings = np.linspace(-1.13, 1.13, num)
    cos, sin = np.cos(yaw + bearings), np.sin(yaw + bearings)
    with np.errstate(divide="ignore"):
        ways = [(ROOM_M[0] - x) / cos, (ROOM_M[2] - x) / cos]
        ways += [(ROOM_M[1] - y) / sin, (ROOM_M[3] - y) / sin]
    ways = np.where(np.array(ways) > 0.0, ways, np.inf)
    ranges = ways.min(axis=0) + rng.normal(0.0, sigma, num)
    return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])


def there_and_back(y, num=80):
    x = np.concatenate([np.linspace(5.0, 25.0, num // 2), np.linspace(25.0, 5.0, num // 2)])
    yaw = np.concatenate([np.full(num // 2, 0.3), np.full(num // 2, np.pi + 0.3)])
    return np.column_stack([x, np.full(num, y), yaw])


def drifted(poses, rng):
    """The same path with an error that grows and wanders."""
    wander = np.cumsum(rng.normal(0.0, [0.012, 0.012, 0.0005], poses.shape), axis=0)
    return poses + wander


def error_m(found, true):
    found, true = np.vstack(found)[:, :2], np.vstack(true)[:, :2]
    T = align_points(found, true)
    return np.sqrt(((T.apply(found) - true) ** 2).sum(axis=1).mean())


@pytest.mark.parametrize("seed", range(3))
def test_paths_come_nearer_to_the_truth(seed):
    rng = np.random.default_rng(seed)
    true = [there_and_back(7.0), there_and_back(13.0)]
    tracks = [Track(drifted(p, rng), [echoes_of_room(q, rng) for q in p]) for p in true]
    before = error_m([t.poses for t in tracks], true)
    after = error_m([found.poses for found in refine_tracks(tracks, 0.05, 0.8)], true)
    assert after < 0.7 * before


def test_what_agrees_already_stays():
    rng = np.random.default_rng(5)
    true = there_and_back(8.0)
    track = Track(true, [echoes_of_room(q, rng) for q in true])
    (found,) = refine_tracks([track], 0.05, 0.8)
    assert np.abs(found.poses[:, :2] - true[:, :2]).max() < 0.05
    assert abs(found.mounting_rad) < 0.002


@pytest.mark.parametrize("seed", range(3))
def test_instruments_that_are_wrong_all_the_time_are_found(seed):
    """A log that says too much by 1 %, a sonar that is turned on the vehicle by 0.6 degrees."""
    rng = np.random.default_rng(seed)
    true = [there_and_back(7.0), there_and_back(13.0)]
    turned_rad = np.radians(0.6)
    tracks = [
        Track(
            p * [1.01, 1.01, 1.0],
            [echoes_of_room(q, rng) for q in p + np.array([0.0, 0.0, turned_rad])],
            drift=np.full((len(p), 2), (0.01, 0.001)),
        )
        for p in true
    ]
    found = refine_tracks(tracks, 0.05, 0.8)
    before = error_m([t.poses for t in tracks], true)
    assert error_m([f.poses for f in found], true) < 0.5 * before
    for track in found:
        assert track.mounting_rad == pytest.approx(turned_rad, abs=0.2 * turned_rad)


def test_the_same_frame_elsewhere_gives_the_same_walls():
    rng = np.random.default_rng(7)
    true = there_and_back(8.0)
    track = Track(drifted(true, rng), [echoes_of_room(q, rng) for q in true])
    T = SE2(100.0, -50.0, 0.0)
    moved = Track(track.poses + T.as_array(), track.echoes)
    (here,), (there,) = refine_tracks([track], 0.05, 0.8), refine_tracks([moved], 0.05, 0.8)
    # Blocks lie elsewhere on the walls, so not to the last digit.
    assert np.abs(there.poses - T.as_array() - here.poses)[:, :2].max() < 0.03


def test_pings_without_echoes_stay_where_they_are():
    poses = there_and_back(8.0)[:10]
    (found,) = refine_tracks([Track(poses, [np.empty((0, 2))] * 10)], 0.05, 0.8)
    np.testing.assert_array_equal(found.poses, poses)


@pytest.mark.parametrize(("scale", "expected"), [(1.03, 1.0 / 1.03), (1.0, 1.0), (0.97, 1.0)])
def test_ranges_that_are_too_long_are_found(scale, expected):
    rng = np.random.default_rng(3)
    true = [there_and_back(7.0), there_and_back(13.0)]
    tracks = [Track(p, [scale * echoes_of_room(q, rng) for q in p]) for p in true]
    assert range_scales(tracks, 0.05, 0.8) == pytest.approx([expected] * 2, abs=0.006)


def test_a_log_that_says_too_little_is_not_taken_for_ranges_that_are_too_long():
    rng = np.random.default_rng(4)
    true = there_and_back(7.0)
    shrunk = Track(true * [0.987, 0.987, 1.0], [echoes_of_room(q, rng) for q in true])
    assert range_scales([shrunk], 0.05, 0.8) == [1.0]


def test_several_vehicles_together_say_that_ranges_are_too_long():
    """One alone might have a bad log."""
    rng = np.random.default_rng(4)
    true = [there_and_back(7.0), there_and_back(13.0), there_and_back(10.0)]
    tracks = [Track(p, [1.015 * echoes_of_room(q, rng) for q in p]) for p in true]
    assert range_scales(tracks[:1], 0.05, 0.8) == [1.0]
    assert range_scales(tracks, 0.05, 0.8) == pytest.approx([1.0 / 1.015] * 3, abs=0.004)


def test_a_path_bends_where_navigation_was_silent():
    """A jump on 2 m of the way back, twelve standard deviations of what it drifts elsewhere."""
    rng = np.random.default_rng(6)
    true = there_and_back(10.0)
    jumped = true + np.where(np.arange(len(true)) > 42, 1.0, 0.0)[:, None] * [0.25, 0.2, 0.0]
    drift = np.full((len(true), 2), (0.015, 0.001))
    silent = drift.copy()
    silent[40:45] = 0.3, 0.001
    errors = []
    for known in (drift, silent):
        track = Track(jumped, [echoes_of_room(q, rng) for q in true], drift=known)
        (found,) = refine_tracks([track], 0.05, 0.8)
        errors.append(error_m([found.poses], [true]))
    assert errors[1] < 0.6 * errors[0]


def reckoned(true, rng, scale=1.0, drift_rad_s=0.0):
    """The path as a log and a gyro say it, in a frame of their own, a ping a second."""
    times_s = np.arange(len(true), dtype=float)
    turned = np.diff(true[:, :2], axis=0)
    angle = 0.7 + drift_rad_s * (times_s[1:] + times_s[:-1]) / 2.0
    steps = scale * np.column_stack([
        np.cos(angle) * turned[:, 0] - np.sin(angle) * turned[:, 1],
        np.sin(angle) * turned[:, 0] + np.cos(angle) * turned[:, 1],
    ])  # fmt: skip
    steps += rng.normal(0.0, 0.002, steps.shape)
    xy = np.cumsum(np.vstack([[3.0, -2.0], steps]), axis=0)
    return times_s, np.column_stack([xy, true[:, 2] + 0.7 + drift_rad_s * times_s])


def with_reckoning(true, rng, ranges=1.0, **wrong):
    times_s, dead = reckoned(true, rng, **wrong)
    echoes = [ranges * echoes_of_room(q, rng) for q in true]
    return Track(drifted(true, rng), echoes, 1.0, None, times_s, dead)


@pytest.mark.parametrize("seed", range(3))
def test_dead_reckoning_is_held_on_to_but_for_its_constants(seed):
    rng = np.random.default_rng(seed)
    true = [there_and_back(7.0), there_and_back(13.0)]
    tracks = [with_reckoning(p, rng, scale=s, drift_rad_s=d)
              for p, s, d in zip(true, (1.006, 0.995), (1e-4, -8e-5), strict=True)]  # fmt: skip
    alone = [dataclasses.replace(track, dead=None) for track in tracks]
    found, without = refine_tracks(tracks, 0.05, 0.8), refine_tracks(alone, 0.05, 0.8)
    assert error_m([f.poses for f in found], true) < 0.03
    assert error_m([f.poses for f in found], true) < error_m([f.poses for f in without], true)


def test_speeds_of_sound_that_differ_are_told_from_one_another():
    """Which one is right only the instruments' own precision says."""
    rng = np.random.default_rng(6)
    true = [there_and_back(7.0), there_and_back(13.0)]
    tracks = [with_reckoning(true[0], rng, 1.004), with_reckoning(true[1], rng, 0.998)]
    first, second = refine_tracks(tracks, 0.05, 0.8)
    assert second.range_scale / first.range_scale == pytest.approx(1.004 / 0.998, abs=0.001)
    # Drawn as large as the mean says, not as small as makes echoes lie nearest to their walls.
    assert first.range_scale == pytest.approx(1.0 / 1.004, abs=0.003)


def test_dead_reckoning_that_is_far_from_the_path_is_left_alone():
    rng = np.random.default_rng(8)
    true = there_and_back(8.0)
    track = with_reckoning(true, rng)
    lost = track.dead + np.column_stack([np.linspace(0.0, 6.0, len(true)) ** 2 / 12.0] * 3)
    of_bad_log = track.dead * [0.92, 0.92, 1.0]
    assert follows(track.dead, track.times_s, track.poses) == pytest.approx((0.0, 1.0), abs=0.2)
    assert follows(lost, track.times_s, track.poses)[0] > 0.2
    assert follows(of_bad_log, track.times_s, track.poses)[1] == pytest.approx(1.087, abs=0.02)
    (without,) = refine_tracks([dataclasses.replace(track, dead=None)], 0.05, 0.8)
    for dead in (lost, of_bad_log):
        (found,) = refine_tracks([dataclasses.replace(track, dead=dead)], 0.05, 0.8)
        np.testing.assert_array_equal(found.poses, without.poses)
