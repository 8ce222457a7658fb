"""People on several vehicles decide; every vehicle that has heard it all has the same log."""

import dataclasses
import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import (
    Decision,
    DecisionKind,
    DecisionLog,
    MapQueue,
    MapQueueConfig,
)
from uw_dslam_ros2.core.merging.steering.decision_bytes import read_decision, write_decision
from uw_dslam_ros2.core.merging.steering.told_decisions import ToldDecisions
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all

ONE, OTHER, THIRD = (SubmapId(f"auv_{k}", 4_000_000_000 + k, 3 * k) for k in (1, 2, 3))
ANN = {"who": "Ann", "stamp_ns": 1_764_230_400_123_000_000}
T = SE2(12.345, -6.789, 2.5)
EACH = [
    Decision(DecisionKind.WITHDRAW, source=ONE, **ANN),
    Decision(DecisionKind.RESTORE, source=ONE, is_run=True, **ANN),
    Decision(DecisionKind.FORBID, source=ONE, target=OTHER, **ANN),
    Decision(
        DecisionKind.CONFIRM, source=ONE, target=OTHER, T_target_source=T,
        sigma_m=0.1, sigma_rad=0.01, **ANN,
    ),
    Decision(
        DecisionKind.REGISTER, source=ONE, target=OTHER, T_target_source=T,
        half_width_m=2.0, half_width_rad=0.2, **ANN,
    ),
    Decision(DecisionKind.PIN, source=OTHER, **ANN),
    Decision(
        DecisionKind.FIX, source=OTHER, point=(1.5, -2.25),
        place=SE2(566_000.1, 5_933_000.7, -3.0), sigma_m=0.5, sigma_rad=math.inf,
        earth_frame="EPSG:32632", **ANN,
    ),
]  # fmt: skip


def by_kind(decision):
    return decision.kind.name


@pytest.mark.parametrize("decision", EACH, ids=by_kind)
def test_a_decision_takes_some_fifty_bytes_and_comes_back(decision):
    data = write_decision(decision)
    assert len(data) <= 60
    got, undone = read_decision(data)
    assert undone == b""
    assert write_decision(got) == data
    for name in ("T_target_source", "place"):
        was, now = getattr(decision, name), getattr(got, name)
        if was is not None:
            assert max(was.distance_to(now)) < 0.001
    whole = {"T_target_source": got.T_target_source, "place": got.place}
    assert dataclasses.replace(decision, **whole) == got


def test_an_undo_names_what_it_undoes():
    undo = Decision(DecisionKind.UNDO, undone=7, **ANN)
    assert read_decision(write_decision(undo, b"abcdef"))[1] == b"abcdef"


@given(st.binary(max_size=70))
def test_noise_is_no_decision_or_a_sound_one(data):
    try:
        got, undone = read_decision(data)
    except InvalidInputError:
        return
    again = write_decision(got, undone)
    assert write_decision(*read_decision(again)) == again


def test_what_no_packet_can_carry_is_refused():
    far = dataclasses.replace(EACH[3], T_target_source=SE2(1e12, 0.0, 0.0))
    with pytest.raises(InvalidInputError, match=r"1000000000000[.]0, expected less than"):
        write_decision(far)


class Vehicle:
    """A log, and what is told of it."""

    def __init__(self):
        self.told, self.log, self.said = ToldDecisions(), DecisionLog(), []

    def decide(self, decision):
        self.log = self.log.added(decision)
        self.settle()

    def settle(self):
        self.log, told = self.told.settle(self.log)
        self.said += told

    def hear(self, *said):
        for data in said:
            self.told.take(data)
        self.settle()


def test_all_that_hear_it_in_any_order_have_the_same_log():
    one, other = Vehicle(), Vehicle()
    one.decide(EACH[0])
    one.decide(EACH[3])
    other.hear(*one.said)
    other.decide(Decision(DecisionKind.UNDO, undone=2, **ANN))  # of what the other one confirmed
    one.decide(EACH[5])  # of which the other does not know
    one.hear(*other.said)
    said = one.said + other.said
    assert len(said) == 4
    logs = []
    for order in itertools.permutations(said):
        late = Vehicle()
        for data in order:
            late.hear(data, data)
        assert late.said == []
        logs.append(tuple(late.log))
    assert set(logs) == {tuple(one.log)}
    (undo,) = (d for d in one.log if d.kind is DecisionKind.UNDO)
    assert list(one.log)[undo.undone - 1].kind is DecisionKind.CONFIRM
    assert one.log.confirmed == []


def test_an_undo_waits_for_what_it_undoes():
    one, other = Vehicle(), Vehicle()
    one.decide(EACH[2])
    one.decide(Decision(DecisionKind.UNDO, undone=1, **ANN))
    other.hear(one.said[1])
    assert len(other.log) == 0
    other.hear(one.said[0])
    assert tuple(other.log) == tuple(one.log)


def test_the_same_again_counts_again():
    one, other = Vehicle(), Vehicle()
    for k in (0, 1, 0):  # out, in, out, within a millisecond
        one.decide(EACH[k])
    other.hear(*reversed(one.said))
    assert len(other.log) == 3
    assert other.log.withdrawn([ONE]) == one.log.withdrawn([ONE]) == {ONE}


def test_who_begins_again_with_a_saved_log_tells_nothing_else():
    one, other = Vehicle(), Vehicle()
    for k in (0, 3, 5):
        one.decide(EACH[k])
    other.hear(*one.said)
    again = Vehicle()
    again.log = other.log
    again.settle()
    assert set(again.said) == set(one.said)
    one.hear(*again.said)
    assert tuple(one.log) == tuple(again.log)


def test_queues_that_hear_the_same_decisions_end_with_the_same_map():
    fleet = three_vehicles(num_submaps=3)
    ids = sorted(fleet.submaps)
    wrong = SE2(3.0, 1.0, 0.5)
    decided = [
        Decision(DecisionKind.WITHDRAW, source=ids[1], **ANN),
        Decision(
            DecisionKind.CONFIRM, source=ids[0], target=ids[5], T_target_source=wrong,
            sigma_m=0.05, sigma_rad=0.01, **ANN,
        ),
    ]  # fmt: skip
    here, there = Vehicle(), Vehicle()
    queues = [MapQueue(MapQueueConfig(anchor_vehicle="auv_2")) for _ in range(2)]
    for submap in fleet.submaps.values():
        queues[0].add_submap(submap)
    answer_all(queues[0], KnowingMatcher(fleet))
    plain = map_bytes(queues[0])
    for decision in decided:
        queues[0].decide(decision)
    here.log = queues[0].decision_log
    here.settle()
    queues[0].take_decisions(here.log)
    answer_all(queues[0], KnowingMatcher(fleet))
    # The other hears of decisions before it has any submap.
    there.hear(*reversed(here.said))
    queues[1].take_decisions(there.log)
    for submap in reversed(fleet.submaps.values()):
        queues[1].add_submap(submap)
    answer_all(queues[1], KnowingMatcher(fleet))
    assert map_bytes(queues[0]) == map_bytes(queues[1])
    assert map_bytes(queues[0]) != plain
    assert [r.decision for r in queues[0].decisions()] == [
        r.decision for r in queues[1].decisions()
    ]


def test_a_pairwise_queue_refuses_a_log_with_what_it_has_not():
    here = Vehicle()
    here.decide(EACH[2])
    with pytest.raises(InvalidInputError, match="FORBID, expected another in mode pairwise"):
        MapQueue(MapQueueConfig(mode="pairwise")).take_decisions(here.log)
