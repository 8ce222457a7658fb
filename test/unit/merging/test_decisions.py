"""What people decide holds, whatever comes and whenever it comes, until it is undone."""

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from unit.merging.deciding import (
    FLEET,
    IDS,
    KNOWING,
    about,
    confirm,
    filled,
    groups,
    id_of,
    remark_of,
    settled,
    true_pose,
    undo,
)
from unit.merging.fleet import map_bytes

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import (
    ConstraintKind,
    Decision,
    DecisionKind,
    DecisionLog,
    MapQueueConfig,
    SubmapState,
)
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import answer_all, make_result, refuse


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
