"""Runs: a mapper that starts again counts from 0 in an odometry frame of its own."""

import dataclasses

import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track, track_name
from uw_dslam_ros2.sim.maps.fleets import (
    Fleet,
    KnowingMatcher,
    answer_all,
    line_of_poses,
    make_walls,
    refuse,
)


def restarted_fleet() -> Fleet:
    """Two vehicles on parallel lines; the first one's mapper starts again halfway."""
    fleet = Fleet(make_walls(120.0, 0.5, 0))
    line = line_of_poses(SE2(30.0, 40.0), 8, 8.0)
    fleet.add_vehicle("auv_1", line[:4], 1, run_id=77)
    fleet.add_vehicle("auv_1", line[4:], 2, run_id=5)
    fleet.add_vehicle("auv_2", line_of_poses(SE2(30.0, 52.0), 8, 8.0), 3, run_id=9)
    return fleet


FLEET = restarted_fleet()


def filled(order=None):
    queue = MapQueue(MapQueueConfig())
    for submap_id in order or sorted(FLEET.submaps, reverse=True):
        queue.add_submap(FLEET.submaps[submap_id])
    return queue


def states(queue):
    return {record.submap.submap_id: record.state for record in queue.submaps()}


def test_runs_of_one_vehicle_are_joined_by_registration_alone():
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    assert set(states(queue).values()) == {SubmapState.MERGED}
    assert FLEET.position_rmse_m(queue) < 0.2
    odometry = [c for c in queue.constraints() if c.kind.name == "ODOMETRY"]
    assert len(odometry) == 3 + 3 + 7
    assert all(c.source.track == c.target.track for c in odometry)


def test_a_run_that_matches_nothing_waits_in_a_frame_of_its_own():
    queue = filled()
    answer_all(queue, refuse)
    assert len({record.component for record in queue.submaps()}) == 3


def test_the_newest_run_says_where_its_vehicle_is():
    old, new = Track("auv_1", 77), Track("auv_1", 5)
    ids = sorted(FLEET.submaps, key=lambda i: (i.track != old, i.track != new, i))
    queue = filled(ids)
    answer_all(queue, KnowingMatcher(FLEET))
    assert queue.newest_run("auv_1") == 5
    assert queue.newest_run("auv_7") == 0
    record = next(r for r in queue.submaps() if r.submap.submap_id == (*new, 3))
    T_map_submap = queue.T_map_odom("auv_1") @ record.submap.T_odom_submap
    assert max(T_map_submap.distance_to(record.T_component_submap)) < 1e-6


def test_people_read_the_second_run_instead_of_its_number():
    queue = filled()
    numbers = sorted({i.run_id for i in FLEET.submaps if i.vehicle_id == "auv_1"})
    shown = {queue.in_words(f"auv_1#{number}/0 came") for number in numbers}
    assert shown == {"auv_1/0 came", "auv_1#2/0 came"}
    assert queue.in_words("auv_9#1936390121/0 came") == "auv_9#1936390121/0 came"


def test_two_runs_may_use_the_same_numbers_but_one_run_may_not():
    queue = filled()
    submap = FLEET.submaps[SubmapId("auv_1", 77, 0)]
    other = FLEET.submaps[SubmapId("auv_2", 9, 0)].grid
    with pytest.raises(InvalidInputError, match=r"auv_1#77/0 .*two vehicles"):
        queue.add_submap(dataclasses.replace(submap, grid=other))
    assert queue.add_submap(dataclasses.replace(submap, grid=other, run_id=78))


@pytest.mark.parametrize("run_id", [-1, 2**32])
def test_a_run_that_no_message_can_hold_is_refused(run_id):
    submap = dataclasses.replace(FLEET.submaps[SubmapId("auv_1", 77, 0)], run_id=run_id)
    with pytest.raises(InvalidInputError, match=f"run_id is {run_id}, expected"):
        MapQueue().add_submap(submap)


def test_names_show_a_run_where_there_may_be_several():
    assert [track_name(Track("auv_1", run)) for run in (0, 1, 2)] == ["auv_1", "auv_1", "auv_1#2"]
    assert str(SubmapId("auv_1", 2, 3)) == "auv_1#2/3"
