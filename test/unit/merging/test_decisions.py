"""What people decide holds, whatever comes and whenever it comes, until it is undone."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import (
    ConstraintKind,
    Decision,
    DecisionKind,
    DecisionLog,
    MapQueue,
    MapQueueConfig,
    SubmapState,
    planning,
)
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.sim.fleets import KnowingMatcher, answer_all, make_result, refuse

FLEET = three_vehicles()
IDS = sorted(FLEET.submaps)
KNOWING = KnowingMatcher(FLEET)
ANN = {"who": "Ann", "stamp_ns": 5}
TRUTH = FLEET.T_world_submap


def id_of(number, sequence):
    return SubmapId(f"auv_{number}", 0, sequence)


def filled(ids=None, config=None):
    queue = MapQueue(config)
    for submap_id in ids or IDS:
        queue.add_submap(FLEET.submaps[submap_id])
    return queue


def settled(matcher=KNOWING, config=None):
    queue = filled(config=config)
    answer_all(queue, matcher)
    return queue


def true_pose(source, target):
    return TRUTH[target].inverse() @ TRUTH[source]


def confirm(source, target, motion=None, **rest):
    sigmas = {"sigma_m": 0.1, "sigma_rad": 0.01} | ANN | rest
    motion = motion or true_pose(source, target)
    return Decision(
        DecisionKind.CONFIRM, source=source, target=target, T_target_source=motion, **sigmas
    )


def about(kind, source, target=None, **rest):
    return Decision(kind, source=source, target=target, **ANN, **rest)


def undo(number):
    return Decision(DecisionKind.UNDO, undone=number, **ANN)


def groups(queue):
    """Which vehicles share a frame."""
    found = {}
    for record in queue.submaps():
        if record.state is not SubmapState.WITHDRAWN:
            found.setdefault(record.component, set()).add(record.submap.vehicle_id)
    return sorted(map(sorted, found.values()))


def remark_of(queue, number):
    return queue.decisions()[number - 1].remark


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(st.integers(0, 8), max_size=9))
def test_what_is_undone_by_something_undone_holds(choices):
    """Against the definition: a decision holds if nothing that holds undoes it."""
    log = DecisionLog()
    for choice in choices:
        kind = undo(choice) if 1 <= choice <= len(log) else about(DecisionKind.PIN, IDS[0])
        try:
            log = log.added(kind)
        except InvalidInputError as error:
            assert "is undone by" in str(error)  # noqa: PT017 (sequences are drawn blindly)

    def holds(number):
        return not any(d.undone == number and holds(d.number) for d in log)

    assert [log.undone_by(d.number) is None for d in log] == [holds(d.number) for d in log]


def test_a_run_that_is_withdrawn_stays_so_with_what_it_sends_later():
    early = filled([i for i in IDS if i.sequence < 2])
    early.decide(about(DecisionKind.WITHDRAW, id_of(3, 0), is_run=True))
    early.decide(about(DecisionKind.RESTORE, id_of(3, 1)))
    for submap_id in reversed(IDS):
        early.add_submap(FLEET.submaps[submap_id])
    newer = dataclasses.replace(FLEET.submaps[id_of(3, 0)], revision=4)
    early.add_submap(newer)
    states = {r.submap.submap_id: r.state for r in early.submaps()}
    assert [states[id_of(3, s)] is SubmapState.WITHDRAWN for s in range(4)] == [
        True,
        False,
        True,
        True,
    ]
    early.decide(undo(1))
    assert SubmapState.WITHDRAWN not in {r.state for r in early.submaps()}


@settings(max_examples=6, deadline=None, derandomize=True)
@given(order=st.permutations(IDS), taken=st.integers(1, len(IDS)))
def test_the_order_of_arrival_does_not_matter_to_what_was_decided(order, taken):
    """Decided as soon as the submaps are there, against decided when all are there."""
    decisions = [
        about(DecisionKind.FORBID, id_of(1, 1), id_of(2, 2)),
        confirm(id_of(3, 1), id_of(2, 1)),
        about(DecisionKind.WITHDRAW, id_of(2, 0)),
    ]
    late, early = filled(), filled(order[:taken])
    waiting = list(decisions)

    def decide_what_can_be():
        held = {r.submap.submap_id for r in early.submaps()}
        while waiting and all(
            end in held for end in (waiting[0].source, waiting[0].target) if end
        ):
            early.decide(waiting.pop(0))

    for submap_id in order[taken:]:
        decide_what_can_be()
        early.add_submap(FLEET.submaps[submap_id])
        for request in early.next_requests(1):
            early.add_result(request.request_id, KNOWING(request))
    decide_what_can_be()
    for decision in decisions:
        late.decide(decision)
    for queue in (early, late):
        answer_all(queue, KNOWING)
    assert map_bytes(early) == map_bytes(late)


def test_forbidden_runs_are_not_asked_and_not_used_until_it_is_undone():
    plain = settled()
    queue = settled()
    queue.decide(about(DecisionKind.FORBID, id_of(1, 0), id_of(2, 0), is_run=True))
    asked = []

    def noting(request):
        asked.append((request.source_ids, request.target_ids))
        return KNOWING(request)

    answer_all(queue, noting)
    pair = {"auv_1", "auv_2"}
    assert not [c for c in queue.constraints() if {c.source[0], c.target[0]} == pair]
    of_both = [{i[0] for i in (*source, *target)} for source, target in asked]
    assert pair not in of_both
    queue.decide(undo(1))
    answer_all(queue, KNOWING)
    assert map_bytes(queue) == map_bytes(plain)


def test_a_forbidden_constraint_is_not_used_and_its_place_not_asked():
    queue = settled()
    edge = next(c for c in queue.constraints() if c.kind is ConstraintKind.REGISTRATION)
    queue.decide(about(DecisionKind.FORBID, edge.target, edge.source))  # the other way round
    asked = []

    def noting(request):
        asked.append({request.source_reference, request.target_reference})
        assert request.prior is None or asked[-1] != {edge.source, edge.target}
        return KNOWING(request)

    answer_all(queue, noting)
    assert {edge.source, edge.target} not in [{c.source, c.target} for c in queue.constraints()]
    assert groups(queue) == [["auv_1", "auv_2", "auv_3"]]  # by the others


def test_what_was_refused_is_joined_when_confirmed_and_apart_again_when_undone():
    queue = settled(refuse)
    apart = map_bytes(queue)
    assert len(groups(queue)) == 3
    queue.decide(confirm(id_of(2, 1), id_of(1, 2)))
    answer_all(queue, refuse)
    assert groups(queue) == [["auv_1", "auv_2"], ["auv_3"]]
    (edge,) = [c for c in queue.constraints() if c.kind is ConstraintKind.CONFIRMED]
    assert (edge.source, edge.target) == (id_of(2, 1), id_of(1, 2))
    assert edge.residual_m < 1e-6
    assert "by a person" in next(
        r.reason for r in queue.submaps() if r.submap.submap_id == id_of(2, 1)
    )
    assert FLEET.position_rmse_m(queue) < 0.3
    queue.decide(undo(1))
    answer_all(queue, refuse)
    assert map_bytes(queue) == apart
    queue.decide(undo(2))
    answer_all(queue, refuse)
    assert groups(queue) == [["auv_1", "auv_2"], ["auv_3"]]


def test_a_confirmed_pose_outweighs_all_that_contradicts_it_and_says_so():
    queue = settled()
    wrong = true_pose(id_of(2, 1), id_of(1, 2)) @ SE2(6.0, 0.0, 0.0)
    queue.decide(confirm(id_of(2, 1), id_of(1, 2), wrong))
    answer_all(queue, KNOWING)
    poses = {r.submap.submap_id: r.T_component_submap for r in queue.submaps()}
    between = poses[id_of(1, 2)].inverse() @ poses[id_of(2, 1)]
    assert between.distance_to(wrong)[0] < 0.2
    assert "contradict" in remark_of(queue, 1)
    queue.decide(confirm(id_of(2, 1), id_of(1, 2)))
    answer_all(queue, KNOWING)
    assert remark_of(queue, 1) == "replaced by a later decision"
    assert remark_of(queue, 2) == ""
    queue.decide(about(DecisionKind.WITHDRAW, id_of(2, 1)))
    assert "auv_2/1 is withdrawn" in remark_of(queue, 2)


def test_forbidding_what_was_confirmed_takes_it_out():
    queue = settled(refuse)
    queue.decide(confirm(id_of(2, 1), id_of(1, 2)))
    queue.decide(about(DecisionKind.FORBID, id_of(1, 2), id_of(2, 1)))
    assert len(groups(queue)) == 3


def test_a_refused_answer_says_which_pose_there_is_to_confirm():
    def unsure(request):
        source, target = request.source_reference, request.target_reference
        result = make_result(true_pose(source, target))
        return dataclasses.replace(result, verdict=Verdict.NOT_ENOUGH_OVERLAP, probability=0.1)

    queue = settled(unsure)
    assert len(groups(queue)) == 3
    for source, target in ((id_of(2, 1), id_of(1, 2)), (id_of(1, 2), id_of(2, 1))):
        motion, sigma_m, sigma_rad = queue.stated_pose(source, target)
        metres, radians = motion.distance_to(true_pose(source, target))
        assert metres < 0.5
        assert radians < 0.05
        assert 0.0 < sigma_m < 1.0
        assert 0.0 < sigma_rad < 0.1
    with pytest.raises(InvalidInputError, match="say which one"):
        settled(refuse).stated_pose(id_of(2, 1), id_of(1, 2))


@pytest.mark.parametrize("is_run", [False, True])
def test_maps_that_a_person_lays_are_registered_there(is_run):
    """A matcher that finds nothing without being told where."""

    def needs_to_be_told(request):
        return refuse(request) if request.prior is None else KNOWING(request)

    queue = settled(needs_to_be_told)
    source, target = id_of(2, 1), id_of(1, 2)
    guess = true_pose(source, target) @ SE2(1.0, -1.5, 0.1)
    window = {"half_width_m": 4.0, "half_width_rad": 0.4}
    register = about(
        DecisionKind.REGISTER, source, target, is_run=is_run, T_target_source=guess, **window
    )
    queue.decide(register)
    (request,) = queue.next_requests(1)
    references = request.source_reference, request.target_reference
    assert [i[0] for i in references] == ["auv_2", "auv_1"]
    true = true_pose(*references)
    middle = request.prior.T_target_source
    assert abs(true.x - middle.x) < request.prior.half_width_m
    assert abs(true.yaw - middle.yaw) < request.prior.half_width_rad
    queue.cancel_request(request.request_id)
    assert remark_of(queue, 1) == "not answered yet"
    answer_all(queue, needs_to_be_told)
    assert "auv_2" in {n for group in groups(queue) if "auv_1" in group for n in group}
    assert remark_of(queue, 1).startswith("ACCEPTED")
    assert FLEET.position_rmse_m(queue) < 0.5
    queue.decide(undo(1))
    answer_all(queue, needs_to_be_told)
    assert len(groups(queue)) == 3


def test_what_is_refused_in_a_window_joins_nothing():
    queue = settled(refuse)
    window = {"half_width_m": 4.0, "half_width_rad": 0.4}
    pose = true_pose(id_of(2, 1), id_of(1, 2))
    queue.decide(
        about(DecisionKind.REGISTER, id_of(2, 1), id_of(1, 2), T_target_source=pose, **window)
    )
    answer_all(queue, refuse)
    assert len(groups(queue)) == 3
    assert "not enough overlap" in remark_of(queue, 1)


def test_the_frame_goes_where_a_person_pins_it_and_back():
    queue = settled()
    before = map_bytes(queue)
    queue.decide(about(DecisionKind.PIN, id_of(2, 2)))
    poses = {r.submap.submap_id: (r.component, r.T_component_submap) for r in queue.submaps()}
    assert poses[id_of(2, 2)] == (0, SE2())
    assert any("as a person decided" in notice for notice in queue.take_notices())
    again = MapQueue.from_state(queue.to_state())
    assert map_bytes(again) == map_bytes(queue) != before
    again.decide(undo(1))
    answer_all(again, KNOWING)
    assert map_bytes(again) == before


@pytest.fixture
def liar(monkeypatch):
    """A queue in which the run of auv_1 is set aside; ``blamed`` holds it, for who forgives."""
    blamed = [id_of(1, 0).track]

    def blame(library, *_):
        return next((t for t in blamed if any(i.track == t for i in library.submaps)), None)

    monkeypatch.setattr(planning, "contradicting_track", blame)
    queue = settled()
    assert {r.state for r in queue.submaps()} == {SubmapState.SET_ASIDE, SubmapState.MERGED}
    return queue, blamed


def test_a_pin_on_what_is_set_aside_waits_and_the_others_keep_their_map(liar):
    queue, blamed = liar
    queue.decide(about(DecisionKind.PIN, id_of(1, 1)))
    answer_all(queue, KNOWING)
    assert {r.submap.vehicle_id for r in queue.submaps() if r.state is SubmapState.MERGED} == {
        "auv_2",
        "auv_3",
    }
    assert remark_of(queue, 1) == "waits: auv_1/1 is set aside"
    blamed.clear()
    queue.add_submap(dataclasses.replace(FLEET.submaps[id_of(1, 3)], revision=1))
    answer_all(queue, KNOWING)
    poses = {r.submap.submap_id: (r.component, r.T_component_submap) for r in queue.submaps()}
    assert poses[id_of(1, 1)] == (0, SE2())
    assert remark_of(queue, 1) == ""


@pytest.mark.parametrize("is_growing", [False, True])
def test_what_a_person_confirms_is_not_set_aside(liar, is_growing):
    queue, _ = liar
    queue.is_growing = is_growing
    queue.decide(confirm(id_of(1, 2), id_of(2, 1)))
    assert SubmapState.SET_ASIDE not in {r.state for r in queue.submaps()}
    assert groups(queue) == [["auv_1", "auv_2", "auv_3"]]
    if not is_growing:
        answer_all(queue, KNOWING)
        assert "auv_1 is in the map because of it, which contradicts" in remark_of(queue, 1)


def fix(submap_id, T_earth_map, queue, point=(0.0, 0.0), yaw=False, off=SE2(), **rest):
    """What somebody says who knows where the map lies on earth."""
    pose = next(r.T_component_submap for r in queue.submaps() if r.submap.submap_id == submap_id)
    x, y = (off @ T_earth_map @ pose).apply(np.array(point))
    values = {"sigma_m": 0.5, "sigma_rad": 0.02 if yaw else math.inf} | rest
    place = SE2(x, y, (T_earth_map @ pose).yaw)
    return about(
        DecisionKind.FIX, submap_id, point=point, place=place, earth_frame="EPSG:32632", **values
    )


def test_fixes_say_where_the_map_lies_on_earth():
    queue = settled()
    T_earth_map = SE2(512_345.6, 5_912_345.6, 2.5)
    queue.decide(fix(id_of(1, 0), T_earth_map, queue, point=(2.0, 1.0)))
    assert queue.georeference() is None
    assert "one more fix" in remark_of(queue, 1)
    queue.decide(fix(id_of(2, 1), T_earth_map, queue))
    found = queue.georeference()
    assert found.earth_frame == "EPSG:32632"
    metres, radians = found.T_earth_map.distance_to(T_earth_map)
    assert metres < 1e-3
    assert radians < 1e-5
    queue.decide(undo(2))
    assert queue.georeference() is None
    queue.decide(fix(id_of(3, 1), T_earth_map, queue, yaw=True))
    metres, radians = queue.georeference().T_earth_map.distance_to(T_earth_map)
    assert metres < 1e-3
    assert radians < 1e-5


def test_a_fix_that_the_others_contradict_is_told():
    queue = settled()
    T_earth_map = SE2(100.0, 200.0, -3.0)
    for submap_id in (id_of(1, 0), id_of(1, 3), id_of(2, 0), id_of(3, 2)):
        queue.decide(fix(submap_id, T_earth_map, queue))
    queue.decide(fix(id_of(3, 0), T_earth_map, queue, off=SE2(20.0, 0.0, 0.0)))
    assert remark_of(queue, 5).startswith("set aside, for the other fixes or the map contradict")
    assert "20.00 m off" in remark_of(queue, 5)
    assert queue.georeference().T_earth_map.distance_to(T_earth_map)[0] < 1e-3
    queue.decide(
        dataclasses.replace(fix(id_of(3, 0), T_earth_map, queue), earth_frame="EPSG:32633")
    )
    assert queue.georeference() is None
    assert "EPSG:32632 and in EPSG:32633" in remark_of(queue, 1)


FULL = {"source": id_of(1, 0), "target": id_of(2, 0), "T_target_source": SE2()}


@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        (DecisionKind.WITHDRAW, {}, "source is None, a WITHDRAW takes one"),
        (DecisionKind.WITHDRAW, {"source": IDS[0], "target": IDS[1]}, "takes none"),
        (DecisionKind.FORBID, {"source": IDS[0], "target": IDS[0]}, "another than the source"),
        (DecisionKind.FORBID, {"source": IDS[0], "target": IDS[1], "is_run": True}, "another"),
        (DecisionKind.CONFIRM, FULL, "sigma_m is 0.0, expected > 0"),
        (DecisionKind.CONFIRM, FULL | {"sigma_m": 1.0, "sigma_rad": math.nan}, "sigma_rad is nan"),
        (DecisionKind.CONFIRM, FULL | {"is_run": True}, "is_run is True"),
        (DecisionKind.REGISTER, FULL | {"half_width_m": -1.0}, "half_width_m is -1.0"),
        (DecisionKind.FIX, {"source": IDS[0], "place": SE2(), "sigma_m": 1.0}, "sigma_rad is 0.0"),
        (
            DecisionKind.FIX,
            {"source": IDS[0], "place": SE2(), "sigma_m": 1.0, "sigma_rad": math.inf},
            "earth_frame is empty",
        ),
        (DecisionKind.UNDO, {}, "undone is 0"),
        (DecisionKind.PIN, {"source": IDS[0], "undone": 2}, "undone is 2"),
        (DecisionKind.PIN, {"source": IDS[0], "who": "x" * 101}, "who has 101 characters"),
    ],
)
def test_a_decision_that_makes_no_sense_is_refused_by_name(kind, fields, message):
    with pytest.raises(InvalidInputError, match=message):
        Decision(kind, **fields)


def test_a_queue_refuses_what_it_cannot_know():
    queue = filled()
    for decision, message in (
        (about(DecisionKind.PIN, id_of(9, 0)), "auv_9/0, which was never received"),
        (undo(1), "undone is 1, expected 1 to 0"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            queue.decide(decision)
    queue.decide(about(DecisionKind.PIN, id_of(1, 0)))
    queue.decide(undo(1))
    with pytest.raises(InvalidInputError, match="1 is undone by 2 already"):
        queue.decide(undo(1))
    assert queue.num_decisions == 2
    plain = filled(config=MapQueueConfig(mode="pairwise"))
    with pytest.raises(InvalidInputError, match="mode pairwise"):
        plain.decide(confirm(id_of(1, 0), id_of(2, 0)))


def test_an_answer_without_a_number_is_nothing_to_confirm():
    queue = settled(lambda _: RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "too slow"))
    with pytest.raises(InvalidInputError, match="has a pose"):
        queue.stated_pose(id_of(1, 0), id_of(2, 0))
