"""By its digest each manager says what its map is drawn from."""

import dataclasses

import numpy as np
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.merging import Decision, DecisionKind, MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher

FLEET = three_vehicles()
LAST = SubmapId("auv_2", 0, 3)


def changes(queue):
    """All that can change a map, one after the other."""
    for submap_id in sorted(FLEET.submaps):
        yield queue.add_submap(FLEET.submaps[submap_id])
    oracle = KnowingMatcher(FLEET)
    while requests := queue.next_requests(1):
        yield queue.add_result(requests[0].request_id, oracle(requests[0]))
    yield queue.withdraw(LAST)
    yield queue.restore(LAST)
    submap = FLEET.submaps[LAST]
    moved = submap.T_odom_submap @ SE2(0.3, 0.0, 0.0)
    yield queue.add_submap(dataclasses.replace(submap, revision=1, T_odom_submap=moved))
    yield queue.decide(Decision(DecisionKind.PIN, source=LAST))
    yield queue.forget_answers("auv_3")


def test_it_is_that_of_a_queue_that_never_gave_one_before():
    queue, seen = MapQueue(), {}
    for _ in changes(queue):
        digest = queue.map_digest()
        assert queue.map_digest() is digest, "worked out once between two changes"
        assert MapQueue.from_state(queue.to_state()).map_digest() == digest
        # Equal digests, equal maps.
        assert seen.setdefault(digest, map_bytes(queue)) == map_bytes(queue)
    assert len(seen) > 5


def test_cells_and_their_place_have_a_digest():
    queue = MapQueue()
    queue.add_submap(FLEET.submaps[LAST])
    drawn = queue.global_map()
    digest = drawn.cells_digest()
    again = dataclasses.replace(drawn, values=drawn.values.copy())
    assert again.cells_digest() == digest
    other = drawn.values.copy()
    other[0, 0] = np.where(other[0, 0] == 50, 51, 50)
    assert dataclasses.replace(drawn, values=other).cells_digest() != digest
    moved = SE2(1.0, 0.0) @ drawn.spec.T_frame_grid
    shifted = dataclasses.replace(drawn.spec, T_frame_grid=moved)
    assert dataclasses.replace(drawn, spec=shifted).cells_digest() != digest
