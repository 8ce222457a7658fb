"""What a queue tells follows from what it holds now: the map's digest, places, edges and loops."""

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


def told(queue):
    """What else follows from the submaps and answers, as text."""
    records = [
        (
            r.submap.submap_id,
            r.submap.revision,
            r.state,
            r.component,
            r.T_component_submap,
            r.reason,
        )
        for r in queue.submaps()
    ]
    edges = [(c.kind, c.source, c.target, c.is_inlier, c.residual_m) for c in queue.constraints()]
    return repr((records, edges, queue.loops()))


def test_all_is_as_a_queue_tells_it_that_never_told_before():
    queue, seen = MapQueue(), {}
    for _ in changes(queue):
        digest = queue.map_digest()
        assert queue.map_digest() is digest, "worked out once between two changes"
        again = MapQueue.from_state(queue.to_state())
        assert again.map_digest() == digest
        assert told(again) == told(queue)
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
