"""The paper's queue: greedy, in order of arrival, nothing taken back."""

import dataclasses

import numpy as np
from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, SubmapState
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, lawnmower_fleet, refuse

FLEET = three_vehicles()
PAIRWISE = MapQueueConfig(mode="pairwise")


def filled(vehicles):
    queue = MapQueue(PAIRWISE)
    for vehicle in vehicles:
        for submap_id in sorted(i for i in FLEET.submaps if i[0] == vehicle):
            queue.add_submap(FLEET.submaps[submap_id])
    return queue


def test_two_are_taken_in_order_of_arrival_and_the_merged_one_goes_back():
    queue = filled(["auv_2", "auv_1", "auv_3"])
    asked = []

    def matcher(request):
        sides = request.target_ids, request.source_ids
        asked.append(tuple(sorted({i[0] for i in ids}) for ids in sides))
        return KnowingMatcher(FLEET)(request)

    answer_all(queue, matcher)
    assert asked == [(["auv_2"], ["auv_1"]), (["auv_3"], ["auv_1", "auv_2"])]
    assert {r.component for r in queue.submaps()} == {0}
    assert FLEET.position_rmse_m(queue) < 0.5
    assert len([c for c in queue.constraints() if c.kind == 2]) == 2


def test_a_refused_map_waits_and_is_tried_with_the_merged_one():
    """The outer two share too little: each meets the middle one."""
    queue = filled(["auv_1", "auv_3", "auv_2"])
    answer_all(queue, KnowingMatcher(FLEET, min_overlap=0.25))
    assert {r.component for r in queue.submaps()} == {0}


def test_it_comes_to_rest_where_nothing_matches():
    queue = filled(["auv_1", "auv_3", "auv_2"])
    assert answer_all(queue, refuse) == 3
    states = {r.submap.vehicle_id: r.state for r in queue.submaps()}
    assert states["auv_1"] is SubmapState.MERGED
    assert states["auv_2"] is states["auv_3"] is SubmapState.WAITING


def test_a_false_match_is_believed_as_the_paper_does():
    queue = filled(["auv_1", "auv_2"])
    answer_all(queue, KnowingMatcher(FLEET, wrong_share=1.0))
    assert {r.component for r in queue.submaps()} == {0}
    assert FLEET.position_rmse_m(queue) > 5.0


def test_nobody_is_set_aside_for_what_others_say():
    """Wrong matches lay maps on water; whoever pins the frame would leave nothing in it."""
    fleet = lawnmower_fleet(5, 5, 1)
    queue = MapQueue(MapQueueConfig(mode="pairwise", anchor_vehicle="auv_01"))
    for number in np.random.default_rng([1, 0]).permutation(5):
        for submap_id in sorted(i for i in fleet.submaps if i[0] == f"auv_{number + 1:02d}"):
            queue.add_submap(fleet.submaps[submap_id])
    answer_all(queue, KnowingMatcher(fleet, 1, wrong_share=0.3))
    assert {record.state for record in queue.submaps()} == {SubmapState.MERGED}


def test_a_withdrawn_vehicle_does_not_stop_the_others():
    queue = filled(["auv_1", "auv_2", "auv_3"])
    for submap_id in [i for i in FLEET.submaps if i[0] == "auv_3"]:
        queue.withdraw(submap_id)
    queue.add_submap(dataclasses.replace(FLEET.submaps["auv_3", 0, 0], revision=1))
    answer_all(queue, KnowingMatcher(FLEET))
    components = {r.submap.vehicle_id: r.component for r in queue.submaps()}
    assert components == {"auv_1": 0, "auv_2": 0, "auv_3": 1}
