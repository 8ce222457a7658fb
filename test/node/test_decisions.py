"""What people decide, through the manager's services."""

import math

import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from node.test_map_queue_manager import FAST, T_ROOM, manage, two_submaps  # noqa: F401
from uw_dslam_msgs.msg import Constraint, Decision, SubmapInfo
from uw_dslam_msgs.srv import Decide, ListDecisions, LoadSession, SaveSession, WithdrawSubmap

from uw_dslam_ros2.core.merging import ConstraintKind, DecisionKind
from uw_dslam_ros2.core.merging import Decision as CoreDecision
from uw_dslam_ros2.core.merging.types import Constraint as CoreConstraint
from uw_dslam_ros2.core.merging.types import SubmapRecord, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.ros.convert.core_types import transform2d_to_msg
from uw_dslam_ros2.ros.convert.decisions import decision_from_msg, decision_to_msg
from uw_dslam_ros2.ros.convert.graph_markers import graph_to_markers
from uw_dslam_ros2.ros.nodes import registration_server
from uw_dslam_ros2.sim.maps.fleets import make_result

pytestmark = pytest.mark.ros

PAIR = {"source_vehicle_id": "auv_2", "target_vehicle_id": "auv_1"}
TRUE = T_ROOM["auv_1"].inverse() @ T_ROOM["auv_2"]


def pose(motion):
    return transform2d_to_msg(motion)


def edges(probe, kind):
    return [edge for edge in probe.statuses[-1].constraints if edge.kind == kind]


@pytest.fixture
def knowing(monkeypatch):
    """A server that knows where the two lie: it is not the search that is tested here."""

    def find(source, target, *_args, **_options):
        is_second = [abs(side.spec.T_frame_grid.yaw) > 1.0 for side in (source, target)]
        assert is_second in ([False, True], [True, False])
        return make_result(TRUE if is_second[0] else TRUE.inverse())

    monkeypatch.setattr(registration_server, "register_grids", find)


@pytest.mark.usefixtures("knowing")
def test_people_forbid_confirm_and_undo(manage, tmp_path):  # noqa: F811
    with manage(**FAST) as (until, probe, call):

        def decide(**fields):
            return call(Decide, "decide", decision=Decision(who="Ann", **fields))

        for submap in two_submaps():
            probe.send(submap)
        until(lambda: probe.num_merged == 2, "the merge")
        forbidden = decide(kind=Decision.FORBID, **PAIR)
        assert (forbidden.result, forbidden.number) == (Decide.Response.DONE, 1)
        until(lambda: probe.num_merged == 1, "the vehicles apart")
        # The pose of the registration that was had.
        said = pose(SE2())
        said.x = math.nan
        confirmed = decide(kind=Decision.CONFIRM, t_target_source=said, **PAIR)
        assert confirmed.number == 2
        until(lambda: probe.num_merged == 2, "the vehicles laid on each other by hand")
        (edge,) = edges(probe, Constraint.CONFIRMED)
        assert math.hypot(edge.t_target_source.x - TRUE.x, edge.t_target_source.y - TRUE.y) < 0.2
        assert probe.statuses[-1].num_decisions == 2
        undone = decide(kind=Decision.UNDO, undone=2)
        until(lambda: probe.num_merged == 1, "the vehicles apart again")
        listed = call(ListDecisions, "list_decisions").decisions
        assert [d.number for d in listed] == [1, 2, undone.number]
        assert [d.is_in_force for d in listed] == [True, False, True]
        assert listed[1].remark == "undone by 3"
        assert {d.who for d in listed} == {"Ann"}
        assert all(d.header.stamp.sec > 0 for d in listed)
        saved = call(SaveSession, "save_session", path=str(tmp_path))
        assert saved.result == saved.DONE
        decide(kind=Decision.UNDO, undone=1)
        until(lambda: probe.num_merged == 2, "all undone")
        loaded = call(LoadSession, "load_session", path=str(tmp_path))
        assert loaded.result == loaded.DONE
        until(lambda: probe.num_merged == 1, "the decisions of the session")
        assert len(call(ListDecisions, "list_decisions").decisions) == 3


@pytest.mark.usefixtures("knowing")
def test_a_map_is_pinned_fixed_and_registered_by_hand(manage):  # noqa: F811
    with manage(**FAST) as (until, probe, call):

        def decide(**fields):
            stamp = {"stamp": Time(sec=77)}
            decision = Decision(who="Bo", **fields)
            decision.header.stamp = stamp["stamp"]
            decision.header.frame_id = "EPSG:32632" if fields["kind"] == Decision.FIX else ""
            return call(Decide, "decide", decision=decision)

        for submap in two_submaps():
            probe.send(submap)
        until(lambda: probe.num_merged == 2, "the merge")
        decide(kind=Decision.PIN, source_vehicle_id="auv_2")
        until(
            lambda: next(
                i.t_component_submap.x == 0.0
                for i in probe.statuses[-1].submaps
                if i.vehicle_id == "auv_2"
            ),
            "the frame of auv_2",
        )
        place = pose(SE2(500_000.0, 6_000_000.0, 1.0))
        fix = {"sigma_m": 1.0, "sigma_rad": 0.1, "place": place, "point_x": 1.0}
        decide(kind=Decision.FIX, source_vehicle_id="auv_2", **fix)
        found = call(ListDecisions, "list_decisions")
        assert found.earth_frame == "EPSG:32632"
        assert found.t_earth_map.x == pytest.approx(500_000.0 - math.cos(1.0))
        assert found.decisions[0].header.stamp.sec == 77
        window = {"half_width_m": 1.0, "half_width_rad": 0.2}
        there = pose(TRUE @ SE2(0.3, 0.2, 0.05))
        decide(kind=Decision.REGISTER, t_target_source=there, **window, **PAIR)
        until(
            lambda: call(ListDecisions, "list_decisions").decisions[2].remark.startswith("ACCEPT"),
            "the registration in the window",
        )


def test_nonsense_is_refused_in_a_sentence_and_withdrawals_are_in_the_log(manage):  # noqa: F811
    with manage(has_server=False, **FAST) as (until, probe, call):
        probe.send(two_submaps()[0])
        until(lambda: probe.num_merged == 1, "the submap")
        for fields, result, message in (
            ({"kind": 99}, Decide.Response.FAILED, "kind is 99"),
            ({"kind": Decision.PIN}, Decide.Response.FAILED, "source is None"),
            (
                {"kind": Decision.PIN, "source_vehicle_id": "auv_9"},
                Decide.Response.NOT_FOUND,
                "no submap auv_9/0",
            ),
            ({"kind": Decision.UNDO, "undone": 4}, Decide.Response.NOT_FOUND, "no decision 4"),
        ):
            response = call(Decide, "decide", decision=Decision(**fields))
            assert response.result == result
            assert message in response.message
        call(WithdrawSubmap, "withdraw_submap", vehicle_id="auv_1", sequence=0)
        until(lambda: probe.states()["auv_1", 0] == SubmapInfo.WITHDRAWN, "the withdrawal")
        (listed,) = call(ListDecisions, "list_decisions").decisions
        assert (listed.kind, listed.who) == (Decision.WITHDRAW, "")


ONE, OTHER = SubmapId("auv_1", 3, 1), SubmapId("auv_2", 4, 2)


@pytest.mark.parametrize(
    "decision",
    [
        CoreDecision(DecisionKind.WITHDRAW, "Ann", 5, ONE, is_run=True, number=1),
        CoreDecision(DecisionKind.FORBID, "", 7, ONE, OTHER, number=2),
        CoreDecision(DecisionKind.CONFIRM, "", 7, ONE, OTHER, False, SE2(1, 2, 3), 0.1, 0.2),
        CoreDecision(
            DecisionKind.REGISTER, "", 7, ONE, OTHER, True, SE2(1, 2, 3), half_width_m=4.0,
            half_width_rad=0.5,
        ),
        CoreDecision(
            DecisionKind.FIX, "", 7, ONE, sigma_m=2.0, sigma_rad=math.inf, point=(3.0, 4.0),
            place=SE2(5.0, 6.0), earth_frame="chart",
        ),
        CoreDecision(DecisionKind.UNDO, "Ann", 5, undone=3, number=4),
    ],
    ids=lambda decision: decision.kind.name,
)  # fmt: skip
def test_a_decision_comes_back_from_its_message(decision):
    assert decision_from_msg(decision_to_msg(decision)) == decision


def record(submap_id, T_map_submap):
    submap = next(s for s in two_submaps() if s.vehicle_id == submap_id.vehicle_id)
    return SubmapRecord(submap, SubmapState.MERGED, 0, T_map_submap, 0, "")


def test_what_a_person_decided_has_marks_of_its_own():
    first, second = (submap.submap_id for submap in two_submaps())
    records = [record(first, SE2()), record(second, SE2(6.0, 8.0))]
    ends = {"source": first, "target": second}
    confirmed = CoreDecision(
        DecisionKind.CONFIRM, **ends, T_target_source=SE2(), sigma_m=1.0, sigma_rad=1.0, number=1
    )
    decisions = [
        confirmed,
        CoreDecision(DecisionKind.FORBID, **ends, number=2),
        CoreDecision(DecisionKind.PIN, source=second, number=3),
    ]
    edge = confirmed.edge()
    constraint = CoreConstraint(
        ConstraintKind.CONFIRMED, first, second, SE2(), edge.covariance, 0.0, 0.0, True
    )
    found = graph_to_markers(records, [constraint], "map", Time(), decisions).markers
    by_name = {(marker.ns, marker.id): marker for marker in found}
    dashes = next(marker for marker in found if marker.ns == "confirmed").points
    assert len(dashes) > 8
    assert (dashes[0].x, dashes[-1].x, dashes[-1].y) == (0.0, 6.0, 8.0)
    cube = by_name["decisions", 1]
    assert (cube.pose.position.x, cube.pose.position.y) == (3.0, 4.0)
    assert len(by_name["decisions", 2].points) == 4
    assert by_name["decisions", 3].text == "pinned"
