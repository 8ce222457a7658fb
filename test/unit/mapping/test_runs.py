"""Runs: a place that nobody knows begins a new one; short silences do not."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from unit.mapping.test_vehicle_mapper import CONFIG, SONAR, S, mission

from uw_dslam_ros2.core.mapping import RunBreak, VehicleRuns
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.navigation import NavigationConfig

EVENTS, TRUTH = mission(60)


def drive(events, is_lost=lambda _kind, _t: False):
    """All submaps, newest revisions, of a mission in which some messages are lost."""
    ids = itertools.count(1)
    runs, submaps = VehicleRuns(CONFIG, "auv_1", lambda: next(ids)), {}
    for kind, t, value in events:
        if is_lost(kind, t):
            continue
        issued = []
        if kind == "yaw":
            issued += runs.note_heading(t)
            runs.mapper.add_imu(t, value, None)
        elif kind == "velocity":
            issued += runs.note_velocity(t, float(np.hypot(*value)))
            runs.mapper.add_velocity(t, value)
        elif not runs.is_blind(t):
            issued += runs.mapper.add_scan(t, *value, 60.0, SONAR)
        submaps |= {s.submap_id: s for s in issued}
    submaps |= {s.submap_id: s for s in runs.finish()}
    return runs, submaps


def lost(role, start_s, end_s):
    return lambda kind, t: kind == role and start_s * S <= t < end_s * S


@pytest.mark.parametrize("role", ["yaw", "velocity"])
def test_a_long_silence_begins_a_new_run(role):
    runs, submaps = drive(EVENTS, lost(role, 15, 36))
    assert len(runs.breaks) == 1
    (reason,) = runs.breaks
    assert (reason.role, round(reason.seconds)) == ("imu" if role == "yaw" else "velocity", 21)
    assert {i.run_id for i in submaps} == {1, 2}
    for run_id in (1, 2):
        assert next(i.sequence for i in sorted(submaps) if i.run_id == run_id) == 0
        stamps = np.concatenate(
            [s.trajectory_stamp_ns for i, s in submaps.items() if i.run_id == run_id]
        )
        is_before = run_id == 1
        assert (stamps < reason.end_ns).all() if is_before else (stamps >= reason.end_ns).all()
    assert runs.diagnostics()["num_runs"] == 2


def test_submaps_of_earlier_runs_can_be_had_again():
    runs, submaps = drive(EVENTS, lost("yaw", 15, 36))
    for submap_id, submap in submaps.items():
        again = runs.issued(submap_id.run_id, submap_id.sequence)
        assert again.submap_id == submap_id
        np.testing.assert_array_equal(again.grid.values, submap.grid.values)
    assert runs.issued(0, 0).run_id == 2
    assert runs.issued(1, 99) is runs.issued(7, 0) is None


def test_no_ping_is_drawn_where_the_heading_is_guessed():
    """Each run by itself is as good as one without a silence: it knows nothing of it."""
    runs, submaps = drive(EVENTS, lost("yaw", 15, 36))
    assert runs.num_pings_blind == 18  # one a second, from 3 s after the last heading on
    for run_id in (1, 2):
        poses, stamps = [], []
        for i in sorted(i for i in submaps if i.run_id == run_id):
            submap = submaps[i]
            poses.append(submap.T_odom_submap.apply(submap.trajectory[:, :2]))
            stamps.append(submap.trajectory_stamp_ns)
        stamps, poses = np.concatenate(stamps), np.concatenate(poses)
        true = TRUTH[(stamps - S // 2) // S, :2]
        error = align_points(poses, true).apply(poses) - true
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.25


@pytest.mark.parametrize(("role", "end_s"), [("yaw", 19), ("velocity", 24)])
def test_a_short_silence_is_bridged(role, end_s):
    runs, submaps = drive(EVENTS, lost(role, 15, end_s))
    assert runs.breaks == []
    assert {i.run_id for i in submaps} == {1}


def test_a_vehicle_that_rests_may_stop_saying_so():
    """Commands of a joystick end when it is let go."""
    runs, _ = drive([])
    for t in range(0, 60, 1):
        runs.note_heading(t * S)
        if not 10 < t < 50:
            assert runs.note_velocity(t * S, 0.0 if 9 <= t < 50 else 0.5) == []
    assert runs.breaks == []


@pytest.mark.parametrize(
    ("speed_m_s", "walk_m_s", "is_new"),
    [(1.0, 0.15, True), (0.15, 0.15, False), (1.0, 0.005, False), (1.0, 0.05, True)],
)
def test_the_way_counts_that_it_may_have_gone_unseen_not_the_time(speed_m_s, walk_m_s, is_new):
    """A slow vehicle, or one known to keep its speed, is not far from where it was going."""
    config = replace(CONFIG, navigation=NavigationConfig(velocity_walk_m_s=walk_m_s))
    ids = itertools.count(1)
    runs = VehicleRuns(config, "auv_1", lambda: next(ids))
    for t in range(60):
        runs.note_heading(t * S)
        runs.mapper.add_imu(t * S, 0.0, None)
        if not 20 < t < 40:
            runs.note_velocity(t * S, speed_m_s)
            runs.mapper.add_velocity(t * S, (speed_m_s, 0.0))
        runs.mapper.add_scan(t * S, [-0.1, 0.0, 0.1], [9.0, 9.0, 9.0], 60.0, SONAR)
    assert len(runs.breaks) == is_new


def test_a_silence_before_anything_is_mapped_is_no_run():
    runs, _ = drive([])
    runs.note_heading(0)
    runs.note_heading(60 * S)
    assert runs.breaks == []


def test_lengths_of_ways_go_on_over_a_break():
    runs, _ = drive(EVENTS, lost("yaw", 15, 36))
    stamps, poses = runs.trajectory()
    assert (np.diff(stamps) > 0).all()
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps.max() < 2.0 * math.pi * 6.5 / 30.0 * 2.0


def test_a_clock_that_jumped_begins_a_new_run_by_hand():
    runs, _ = drive(EVENTS[:600])
    before = runs.mapper
    runs.begin(RunBreak("", 5, 3))
    assert runs.mapper is not before
    assert not runs.mapper.is_started
