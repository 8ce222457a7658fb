"""Positions of recordings become fixes of the submaps that were mapped at their times."""

import dataclasses
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.earth import utm_position
from uw_dslam_ros2.io.fixes import FixLog, fixes_of_recordings
from uw_dslam_ros2.io.readings import FixEvent
from uw_dslam_ros2.io.sessions.session import load_session, save_session

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def submap(vehicle, sequence, first_s, last_s):
    """One that its vehicle goes along the x axis of, a metre a second."""
    stamps = START + np.arange(first_s, last_s + 1) * SECOND
    way = np.column_stack([np.arange(len(stamps)), np.zeros((len(stamps), 2))]).astype(float)
    grid = OccupancyMap(GridSpec(0.5, 4, 4), np.full((4, 4), 100, np.int8))
    return Submap(
        vehicle, sequence, 0, True, int(stamps[-1]), SE2(30.0 * sequence), np.eye(3) * 1e-4, grid,
        trajectory=way, trajectory_stamp_ns=stamps, run_id=1,
    )  # fmt: skip


SUBMAPS = [submap("auv_1", 0, 0, 30), submap("auv_1", 1, 30, 60), submap("auv_2", 0, 0, 60)]


def event(vehicle, time_s, position=(5.0, 6.0), sigma_m=None, frame="sea", **rest):
    covariance = None if sigma_m is None else np.eye(2) * sigma_m**2
    stamp_ns = START + int(time_s * SECOND)
    return FixEvent(vehicle, stamp_ns, frame, np.array(position), covariance, **rest)


def test_a_fix_is_of_the_point_where_its_vehicle_was():
    events = {"auv_1": [event("auv_1", t) for t in (4.5, 30.0, 52.0, 400.0)]}
    fixes = fixes_of_recordings(events, SUBMAPS, 1.5)
    ids = [SubmapId("auv_1", 1, k) for k in (0, 1, 1)]
    assert [fix.submap_id for fix in fixes] == ids, "at a seam the later one's word counts"
    assert [fix.point for fix in fixes] == [(4.5, 0.0), (0.0, 0.0), (22.0, 0.0)]
    assert {(fix.sigma_m, fix.sigma_rad, fix.earth_frame) for fix in fixes} == {
        (1.5, math.inf, "sea")
    }


def test_of_ten_seconds_the_surest_counts_and_none_is_surer_than_said():
    sigmas = [(1.0, 3.0), (4.0, 2.0), (9.0, 2.5), (12.0, 0.2)]
    events = {"auv_2": [event("auv_2", t, sigma_m=sigma) for t, sigma in sigmas]}
    fixes = fixes_of_recordings(events, SUBMAPS, 0.5)
    assert [fix.sigma_m for fix in fixes] == pytest.approx([2.0, 0.5])


def test_latitudes_of_all_vehicles_become_one_zone():
    # Across the border of two zones.
    places = {"auv_1": (54.0, 11.9995), "auv_2": (54.0, 12.0005)}
    events = {v: [event(v, 5.0, place, is_geodetic=True)] for v, place in places.items()}
    fixes = fixes_of_recordings(events, SUBMAPS, 1.0)
    assert {fix.earth_frame for fix in fixes} == {"EPSG:32632"}
    for fix, place in zip(fixes, places.values(), strict=True):
        assert (fix.place.x, fix.place.y) == utm_position(*place, "EPSG:32632")
    assert math.hypot(fixes[0].place.x - fixes[1].place.x, 0.0) == pytest.approx(65.5, abs=1.0)


def test_fixes_are_kept_in_a_session(tmp_path):
    queue = MapQueue()
    for one in SUBMAPS[:2]:
        queue.add_submap(one)
    # The true way is turned by a quarter, and lies far away.
    events = [event("auv_1", t, (1000.0, 2000.0 + t)) for t in (2.0, 28.0, 55.0)]
    queue.add_fixes(fixes_of_recordings({"auv_1": events}, SUBMAPS, 0.5))
    found = queue.georeference()
    assert found.T_earth_map.as_array() == pytest.approx([1000.0, 2000.0, 0.5 * math.pi], abs=1e-3)
    assert [fit.is_used for fit in found.fits] == [True] * 3
    save_session(tmp_path, queue)
    assert load_session(tmp_path).georeference() == found


def test_a_fix_of_a_stranger_is_refused():
    queue = MapQueue()
    queue.add_submap(SUBMAPS[0])
    fixes = fixes_of_recordings({"auv_2": [event("auv_2", 3.0)]}, SUBMAPS, 1.0)
    with pytest.raises(ValueError, match=r"fix.submap_id is auv_2/0, which was never received"):
        queue.add_fixes(fixes)


def test_what_comes_live_says_what_a_recording_says_in_whatever_order_it_comes(rng):
    way = [(t, (1000.0, 2000.0 + t)) for t in (2.0, 25.0, 37.0, 52.0)]
    sure = {25.0: 0.6, 52.0: 0.7}  # the others are taken for less sure: 1 m
    found = []
    for _ in range(4):
        log = FixLog(0.5)
        for index in rng.permutation(len(way)):
            time_s, place = way[index]
            log.note(event("auv_1/usbl", time_s, place, sigma_m=sure.get(time_s, 1.0)))
        found.append(log.fixes(SUBMAPS))
    assert all(fixes == found[0] for fixes in found)
    events = {"auv_1": [event("auv_1", t, p, sigma_m=sure[t]) for t, p in way if t in sure]}
    assert found[0] == fixes_of_recordings(events, SUBMAPS, 0.5), "the surest of each submap"


def test_a_fast_receiver_needs_no_more_memory_than_a_slow_one():
    slow, fast = FixLog(1.0), FixLog(1.0)
    for tenth in range(600):
        one = event("auv_1/gps/fix", tenth / 10.0)
        fast.note(one)
        if tenth % 100 == 0:
            slow.note(one)
    assert len(fast._kept) == len(slow._kept)
    assert fast.fixes(SUBMAPS) == slow.fixes(SUBMAPS)


def test_fixes_wait_for_their_vehicle_and_are_of_no_other():
    log = FixLog(1.0)
    log.note(event("auv_1/usbl", 5.0))
    log.note(event("auv_10/usbl", 5.0))
    assert log.fixes(SUBMAPS[2:]) == []
    assert [fix.submap_id for fix in log.fixes(SUBMAPS)] == [SubmapId("auv_1", 1, 0)]
    tenth = dataclasses.replace(SUBMAPS[0], vehicle_id="auv_10")
    assert {fix.submap_id.vehicle_id for fix in log.fixes([*SUBMAPS, tenth])} == {
        "auv_1",
        "auv_10",
    }


def test_what_is_said_of_a_submap_takes_the_place_of_what_was_said():
    queue = MapQueue()
    for one in SUBMAPS:
        queue.add_submap(one)
    first, second = (
        fixes_of_recordings({"auv_1": [event("auv_1", t, (x, 0.0)) for t in times]}, SUBMAPS, 1.0)
        for times, x in (((5.0, 40.0), 1.0), ((45.0,), 2.0))
    )
    assert queue.add_fixes(first)
    assert not queue.add_fixes(first)
    assert queue.add_fixes(second)
    assert queue.to_state().fixes == (first[0], second[0])
