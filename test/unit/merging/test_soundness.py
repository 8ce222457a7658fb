"""What one vehicle sends cannot bend, displace or stop the map of the others."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from unit.merging.fleet import map_bytes

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, SubmapState
from uw_dslam_ros2.core.merging import planning as planning_module
from uw_dslam_ros2.core.merging.checks.soundness import contested_track, contradicting_track
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.constraints import constraint_of
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, SubmapGroup
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track
from uw_dslam_ros2.sim.maps.fleets import (
    Fleet,
    KnowingMatcher,
    answer_all,
    line_of_poses,
    make_walls,
    refuse,
)

WORLD = make_walls(90.0, 0.5, 0)


def fleet_of(num_vehicles=2, num_submaps=3):
    fleet = Fleet(WORLD)
    for index in range(num_vehicles):
        poses = line_of_poses(SE2(20.0, 25.0 + 9.0 * index), num_submaps, 8.0)
        fleet.add_vehicle(f"auv_{index + 1}", poses, index, run_id=10 + index)
    return fleet


def filled(submaps, config=None):
    queue = MapQueue(config)
    for submap in submaps:
        queue.add_submap(submap)
    return queue


def by_vehicle(queue):
    found = {}
    for record in queue.submaps():
        found.setdefault(record.submap.vehicle_id, set()).add(record.state)
    return found


def moved(submap, motion, **changes):
    return dataclasses.replace(submap, T_odom_submap=motion @ submap.T_odom_submap, **changes)


# --- odometry that leaps


def test_a_run_that_leaps_keeps_its_longest_piece_until_a_revision_mends_it():
    fleet = fleet_of(2, 5)
    far = SE2(200.0, 0.0)
    broken = [
        moved(s, far) if i.vehicle_id == "auv_1" and i.sequence >= 3 else s
        for i, s in fleet.submaps.items()
    ]
    queue = filled(broken)
    answer_all(queue, KnowingMatcher(fleet))
    aside = [r for r in queue.submaps() if r.state is SubmapState.SET_ASIDE]
    assert [r.submap.sequence for r in aside] == [3, 4]
    assert "odometry leaps" in aside[0].reason
    assert "from auv_1#10/2 to auv_1#10/3" in aside[0].reason
    assert fleet.position_rmse_m(queue) < 0.3
    for i in [i for i in fleet.submaps if i.vehicle_id == "auv_1" and i.sequence >= 3]:
        queue.add_submap(dataclasses.replace(fleet.submaps[i], revision=1))
    answer_all(queue, KnowingMatcher(fleet))
    assert by_vehicle(queue)["auv_1"] == {SubmapState.MERGED}


def test_a_fast_vehicle_and_a_long_pause_are_no_leap():
    fleet = fleet_of(1, 4)
    later_ns = 3_600_000_000_000
    submaps = [
        moved(
            s,
            SE2(300.0, 0.0),
            stamp_ns=s.stamp_ns + later_ns,
            trajectory_stamp_ns=s.trajectory_stamp_ns + later_ns,
        )
        if i.sequence >= 2
        else s
        for i, s in fleet.submaps.items()
    ]
    assert by_vehicle(filled(submaps)) == {"auv_1": {SubmapState.MERGED}}


# --- a liar


def test_a_bent_copy_of_a_map_does_not_bend_or_displace_the_others():
    fleet = fleet_of(3, 3)
    honest = dict(fleet.submaps)
    copy = [
        dataclasses.replace(s, vehicle_id="auv_9", run_id=99)
        for i, s in honest.items()
        if i.vehicle_id == "auv_2"
    ]
    truth = fleet.T_world_submap
    truth |= {s.submap_id: truth[SubmapId("auv_2", 11, s.sequence)] for s in copy}
    bent = [
        dataclasses.replace(s, T_odom_submap=s.T_odom_submap @ SE2(0.0, 6.0 * s.sequence, 0.4))
        for s in copy
    ]
    queue = filled([*bent, *honest.values()])
    answer_all(queue, KnowingMatcher(fleet))
    states = by_vehicle(queue)
    assert set.union(*(states[i.vehicle_id] for i in honest)) == {SubmapState.MERGED}
    found = {r.submap.submap_id: r.T_component_submap for r in queue.submaps()}
    first = min(honest)
    errors = [
        (found[first].inverse() @ found[i]).distance_to(truth[first].inverse() @ truth[i])[0]
        for i in honest
    ]
    assert max(errors) < 0.3


def constraint(number, source, target, T_target_source):
    key = (bytes([number]), b"", ())
    return Constraint(key, Edge(source, target, T_target_source, np.diag([0.01] * 3)), 0.9)


def judged(matches):
    """Who contradicts the rest, of four vehicles with a submap each in one place."""
    fleet = fleet_of(4, 1)
    ids = sorted(fleet.submaps)
    library = Library(
        {i: StoredSubmap.of(s, 10**6) for i, s in fleet.submaps.items()}, DecisionLog(), Memory()
    )
    constraints = [
        constraint(number, ids[a], ids[b], SE2(shift_m, 0.0))
        for number, (a, b, shift_m) in enumerate(matches)
    ]
    solved, _ = library.solve(ids[0], constraints)
    found = contradicting_track(library, solved, ids[0])
    return None if found is None else found.vehicle_id


HONEST = [(0, 1, 0.0), (1, 2, 0.0), (0, 2, 0.0)] * 2


def test_who_contradicts_most_of_the_others_is_set_aside():
    assert judged(HONEST) is None
    assert judged([*HONEST, (3, 0, 5.0), (3, 1, -9.0), (3, 2, 7.0), (3, 1, 20.0)]) == "auv_4"


def test_a_single_false_match_makes_nobody_a_liar():
    assert judged([*HONEST, (0, 1, 8.0)]) is None
    assert judged([(0, 1, 0.0), (1, 2, 0.0), (0, 2, 8.0)]) is None


def contested(matches, num_submaps=1, *, is_confirmed=True):
    """Whose place is contested, of four vehicles in one place; ends are (vehicle, submap)."""
    fleet = fleet_of(4, num_submaps)
    ids = sorted(fleet.submaps)
    library = Library(
        {i: StoredSubmap.of(s, 10**6) for i, s in fleet.submaps.items()}, DecisionLog(), Memory()
    )
    truth = fleet.T_world_submap
    answers = []
    for a, b, shift_m, probability in matches:
        source, target = (ids[end[0] * num_submaps + end[1]] for end in (a, b))
        groups = [SubmapGroup.of([library.submaps[i]], [SE2()], 0) for i in (source, target)]
        motion = SE2(shift_m, 0.0) @ truth[target].inverse() @ truth[source]
        window = PriorWindow(motion, 5.0, 0.5)  # one pair, asked at two places
        answers.append(
            Answer(Query(*groups, window), Verdict.ACCEPTED, "", motion,
                   np.diag([0.01, 0.01, 1e-4]), probability)
        )  # fmt: skip
    assert all(answer.is_accepted for answer in answers)
    # What checks do not confirm is no constraint, and was accepted all the same.
    believed = [
        constraint_of(library, answer)
        for answer, (*_, shift_m, _) in zip(answers, matches, strict=True)
        if is_confirmed or shift_m == 0.0
    ]
    solved, components = library.solve(ids[0], believed)
    found = contested_track(library, solved, answers, components)
    return None if found is None else (found.track.vehicle_id, round(found.distance_m))


FIRM = [((0, 0), (1, 0), 0.0, 0.99), ((1, 0), (2, 0), 0.0, 0.99), ((0, 0), (2, 0), 0.0, 0.99)]
HERE = [((3, 0), (v, 0), 0.0, 0.94) for v in (0, 1, 2)]


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_a_submap_that_looks_like_two_places_is_in_neither(is_confirmed):
    """However many have seen the one place: that they agree says nothing about the submap."""
    judge = functools.partial(contested, is_confirmed=is_confirmed)
    assert judge([*FIRM, *HERE]) is None
    assert judge([*FIRM, *HERE, ((3, 0), (1, 0), 40.0, 0.95)]) == ("auv_4", 40)
    assert judge([*FIRM, *HERE, ((3, 0), (1, 0), 40.0, 0.8)]) is None  # 16 : 4
    assert judge([*FIRM, *HERE, ((3, 0), (1, 0), 40.0, 0.85)]) == ("auv_4", 40)
    sure = ((3, 0), (2, 0), 0.0, 0.98)
    assert judge([*FIRM, *HERE, sure, ((3, 0), (1, 0), 40.0, 0.95)]) is None


def test_a_pose_that_is_bent_is_no_other_place():
    assert contested([*FIRM, *HERE, ((3, 0), (1, 0), 1.5, 0.95)]) is None


def test_two_submaps_of_a_run_outweigh_a_third_that_looks_like_another_place():
    firm = [((v, 0), (v + 1, 0), 0.0, 0.99) for v in (0, 1)]
    here = [((3, k), (v, k), 0.0, 0.94) for k in (0, 1) for v in (0, 1, 2)]
    there = ((3, 2), (1, 2), 40.0, 0.95)
    assert contested([*firm, *here, there], num_submaps=3) is None
    assert contested([*firm, *here[:3], there], num_submaps=3) == ("auv_4", 40)


def test_a_run_that_contradicts_the_rest_is_set_aside_until_it_does_not(monkeypatch):
    fleet = fleet_of(3, 2)
    queue = filled(fleet.submaps.values())
    answer_all(queue, KnowingMatcher(fleet))
    liar = Track("auv_1", 10)
    blamed = [liar]

    def blame(library, *_):
        return liar if blamed and any(i.track == liar for i in library.submaps) else None

    monkeypatch.setattr(planning_module, "contradicting_track", blame)
    queue.withdraw(max(fleet.submaps))
    answer_all(queue, KnowingMatcher(fleet))
    states = by_vehicle(queue)
    assert states["auv_1"] == {SubmapState.SET_ASIDE}
    assert states["auv_2"] == {SubmapState.MERGED}  # the frame has gone over to the others
    assert "contradicts the others" in queue.submaps()[0].reason
    assert any("global frame is now that of auv_2" in notice for notice in queue.take_notices())
    blamed.clear()
    queue.restore(max(fleet.submaps))
    answer_all(queue, KnowingMatcher(fleet))
    assert set.union(*by_vehicle(queue).values()) == {SubmapState.MERGED}


def test_a_revision_that_leaps_is_refused_and_the_next_one_is_taken():
    fleet = fleet_of(1, 1)
    (submap,) = fleet.submaps.values()
    queue = filled([submap])
    with pytest.raises(InvalidInputError, match=r"auv_1#10/0 leaps to revision 4294967295"):
        queue.add_submap(dataclasses.replace(submap, revision=2**32 - 1))
    assert queue.add_submap(dataclasses.replace(submap, revision=1))


# --- poison


def room(resolution_m, num_cells=40):
    values = np.zeros((num_cells, num_cells), np.int8)
    values[[0, -1]] = values[:, [0, -1]] = 100
    half_m = 0.5 * num_cells * resolution_m
    return OccupancyMap(
        GridSpec(resolution_m, num_cells, num_cells, SE2(-half_m, -half_m)), values
    )


def poison(sequence, **changes):
    fleet = fleet_of(1, 2)
    submap = fleet.submaps[SubmapId("auv_1", 10, sequence)]
    return dataclasses.replace(submap, vehicle_id="poison", run_id=66, **changes)


@pytest.mark.parametrize(
    "submaps",
    [
        [poison(0), moved(poison(1), SE2(30_000.0, 0.0), covariance=np.diag([1e9, 1e9, 1.0]))],
        [poison(0, grid=room(0.001)), poison(1, grid=room(10.0))],
        [poison(0, grid=room(10.0)), poison(1, grid=room(0.001))],
    ],
)
@pytest.mark.parametrize("name", ["poison", "a_poison"])
def test_what_cannot_be_one_map_stops_nobody(submaps, name):
    """Far apart, or of other cells; by its name it may pin the frame, until others are joined."""
    fleet = fleet_of(2, 2)
    submaps = [dataclasses.replace(submap, vehicle_id=name) for submap in submaps]
    queue = filled([*submaps, *fleet.submaps.values()])

    def answer(request):
        ids = (*request.source_ids, *request.target_ids)
        is_poison = any(i.vehicle_id == name for i in ids)
        return refuse(request) if is_poison else KnowingMatcher(fleet)(request)

    assert queue.global_map() is not None
    answer_all(queue, answer)
    assert queue.global_map().values.size < 1_000_000
    states = by_vehicle(queue)
    assert states["auv_1"] == states["auv_2"] == {SubmapState.MERGED}
    assert queue.provenance() is not None
    resumed = MapQueue.from_state(queue.to_state())
    assert map_bytes(resumed) == map_bytes(queue)


def test_what_is_too_far_away_to_be_drawn_says_so():
    fleet = fleet_of(1, 2)
    first, second = fleet.submaps.values()
    away = moved(second, SE2(30_000.0, 0.0), covariance=np.diag([1e9, 1e9, 1.0]))
    queue = filled([first, away])
    assert queue.global_map().spec.shape == first.grid.spec.shape
    reason = queue.submaps()[1].reason
    assert "not drawn: it lies 30" in reason
    assert "at most 20000 cells a side (10000 m)" in reason


def test_a_pose_beyond_all_measure_is_refused():
    (submap, _) = fleet_of(1, 2).submaps.values()
    with pytest.raises(InvalidInputError, match=r"lies 1e.300 m from odom's origin"):
        filled([dataclasses.replace(submap, T_odom_submap=SE2(1e300, 0.0, 0.0))])


# --- what pins the frame


def test_the_frame_does_not_depend_on_who_came_first():
    fleet = fleet_of(2, 2)
    queues = []
    for order in (sorted(fleet.submaps), sorted(fleet.submaps, reverse=True)):
        queue = MapQueue()
        for submap_id in order:
            queue.add_submap(fleet.submaps[submap_id])
            assert queue.global_map() is not None
        queues.append(queue)
        answer_all(queue, KnowingMatcher(fleet))
    assert map_bytes(queues[0]) == map_bytes(queues[1])
    assert queues[0].take_notices() == []
    assert any("global frame is now that of auv_1#10/0" in n for n in queues[1].take_notices())


def test_the_frame_stays_once_vehicles_are_joined_in_it():
    fleet = fleet_of(3, 2)
    late = [s for i, s in fleet.submaps.items() if i.vehicle_id == "auv_1"]
    queue = filled([s for i, s in fleet.submaps.items() if i.vehicle_id != "auv_1"])
    answer_all(queue, KnowingMatcher(fleet))
    queue.take_notices()
    for submap in late:
        queue.add_submap(submap)
    answer_all(queue, KnowingMatcher(fleet))
    assert queue.take_notices() == []
    pinned = next(r for r in queue.submaps() if r.submap.vehicle_id == "auv_2")
    assert pinned.T_component_submap == SE2()
    assert {r.component for r in queue.submaps()} == {0}


def test_a_named_vehicle_pins_the_frame_by_its_first_submap_whichever_comes_first():
    fleet = fleet_of(2, 3)
    queue = filled([*fleet.submaps.values()][::-1], MapQueueConfig(anchor_vehicle="auv_2"))
    answer_all(queue, KnowingMatcher(fleet))
    poses = {r.submap.submap_id: r.T_component_submap for r in queue.submaps()}
    assert poses[SubmapId("auv_2", 11, 0)] == SE2()
    assert math.isfinite(fleet.position_rmse_m(queue))


def test_a_first_submap_that_comes_after_all_are_joined_pins_the_frame_all_the_same():
    fleet = fleet_of(2, 3)
    config = MapQueueConfig(anchor_vehicle="auv_1")
    first = min(fleet.submaps)
    straight = filled(fleet.submaps.values(), config)
    answer_all(straight, KnowingMatcher(fleet))
    late = filled([s for i, s in fleet.submaps.items() if i != first], config)
    answer_all(late, KnowingMatcher(fleet))
    assert len(late.trajectories()) == 2, "joined without it"
    assert map_bytes(late) != map_bytes(straight)
    late.add_submap(fleet.submaps[first])
    answer_all(late, KnowingMatcher(fleet))
    assert map_bytes(late) == map_bytes(straight)
    assert late.take_notices() == [
        f"the global frame is now that of {first}, which came late; it was that of auv_1#10/1"
    ]
