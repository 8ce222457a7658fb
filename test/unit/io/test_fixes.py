"""Positions of recordings become fixes of the submaps that were mapped at their times."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.earth import utm_position
from uw_dslam_ros2.io.fixes import fixes_of_recordings
from uw_dslam_ros2.io.readings import FixEvent
from uw_dslam_ros2.io.session import load_session, save_session

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
