"""Properties of the queue, with a matcher that knows the truth."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import ConstraintKind, MapQueue, MapQueueConfig, SubmapState
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.solving import loop_errors
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, lawnmower_fleet, refuse

FLEET = three_vehicles()
IDS = sorted(FLEET.submaps)


def filled(ids=None, config=None, fleet=FLEET) -> MapQueue:
    queue = MapQueue(config)
    for submap_id in ids or sorted(fleet.submaps):
        queue.add_submap(fleet.submaps[submap_id])
    return queue


def test_three_vehicles_become_one_map():
    queue = filled()
    oracle = KnowingMatcher(FLEET)
    answer_all(queue, oracle)
    records = queue.submaps()
    assert [r.submap.submap_id for r in records] == IDS
    assert all(r.state is SubmapState.MERGED and r.component == 0 for r in records)
    assert FLEET.position_rmse_m(queue) < 0.15
    assert set(queue.trajectories()) == {"auv_1", "auv_2", "auv_3"}
    assert oracle.num_asked < len(IDS) * (len(IDS) - 1) / 2


def test_each_vehicle_is_one_component_before_any_match():
    queue = filled()
    components = {r.submap.vehicle_id: r.component for r in queue.submaps()}
    assert components == {"auv_1": 0, "auv_2": 1, "auv_3": 2}
    assert queue.T_map_odom("auv_1") is not None
    assert queue.T_map_odom("auv_2") is None
    assert set(queue.trajectories()) == {"auv_1"}


def test_refused_vehicles_wait_with_the_reason():
    queue = filled()
    answer_all(queue, refuse)
    waiting = [r for r in queue.submaps() if r.submap.vehicle_id != "auv_1"]
    assert all(r.state is SubmapState.WAITING for r in waiting)
    assert all(r.reason == "not enough overlap" and r.num_tries > 0 for r in waiting)
    assert set(queue.trajectories()) == {"auv_1"}


def all_but_the_first(request):
    """Answers that join auv_2 and auv_3, and never auv_1."""
    ids = {i[0] for i in (*request.source_ids, *request.target_ids)}
    return (refuse if "auv_1" in ids else KnowingMatcher(FLEET))(request)


def test_the_frame_goes_over_to_where_vehicles_are_joined_and_stays():
    queue = filled()
    assert set(queue.trajectories()) == {"auv_1"}
    assert queue.global_map() is not None
    queue.changed_window()
    answer_all(queue, all_but_the_first)
    assert set(queue.trajectories()) == {"auv_2", "auv_3"}
    assert queue.changed_window() is not None
    first = next(r for r in queue.submaps() if r.submap.submap_id == ("auv_2", 0, 0))
    assert (first.component, first.T_component_submap) == (0, SE2())
    again = MapQueue.from_state(queue.to_state())
    assert map_bytes(again) == map_bytes(queue)
    for submap_id in IDS:
        if submap_id[0] == "auv_3":
            queue.withdraw(submap_id)
    answer_all(queue, all_but_the_first)
    first = next(r for r in queue.submaps() if r.submap.submap_id == ("auv_2", 0, 0))
    assert (first.component, first.T_component_submap) == (0, SE2())
    assert set(queue.trajectories()) == {"auv_2"}


def test_a_named_anchor_keeps_the_frame_alone():
    queue = filled(config=MapQueueConfig(anchor_vehicle="auv_1"))
    answer_all(queue, all_but_the_first)
    assert set(queue.trajectories()) == {"auv_1"}


@settings(max_examples=12, deadline=None, derandomize=True)
@given(order=st.permutations(IDS), batch=st.integers(1, 7))
def test_any_order_of_arrival_gives_the_same_bytes(order, batch):
    """Submaps one by one, some answered in between, some twice; the frame is pinned by name."""
    config = MapQueueConfig(anchor_vehicle="auv_1")
    straight = filled(IDS, config)
    answer_all(straight, KnowingMatcher(FLEET))
    queue = MapQueue(config)
    oracle = KnowingMatcher(FLEET)
    for count, submap_id in enumerate(order):
        queue.add_submap(FLEET.submaps[submap_id])
        queue.add_submap(FLEET.submaps[order[0]])
        if count % batch == 0:
            for request in reversed(queue.next_requests(2)):
                queue.add_result(request.request_id, oracle(request))
    answer_all(queue, oracle, batch)
    assert map_bytes(queue) == map_bytes(straight)


def test_the_same_revision_twice_and_older_ones_change_nothing():
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    before = map_bytes(queue)
    queue.changed_window()
    newer = dataclasses.replace(FLEET.submaps["auv_2", 0, 1], revision=1)
    queue.add_submap(newer)
    queue.add_submap(FLEET.submaps["auv_2", 0, 1])
    queue.add_submap(newer)
    answer_all(queue, KnowingMatcher(FLEET))
    assert map_bytes(queue) == before
    assert queue.changed_window() is None
    assert (
        next(r for r in queue.submaps() if r.submap.submap_id == ("auv_2", 0, 1)).submap is newer
    )


def test_a_revision_replaces_the_evidence():
    queue = filled([("auv_1", 0, 0)])
    submap = FLEET.submaps["auv_1", 0, 0]
    grid = dataclasses.replace(
        submap.grid, values=np.where(submap.grid.known, 100, -1).astype("i1")
    )
    queue.add_submap(dataclasses.replace(submap, revision=3, grid=grid))
    fused = queue.global_map()
    assert set(np.unique(fused.values) >= 99) == {False, True}
    assert set(np.unique(fused.values[fused.known]) >= 99) == {True}


def test_two_submaps_under_one_name_are_refused():
    queue = filled([("auv_1", 0, 0)])
    other = dataclasses.replace(FLEET.submaps["auv_1", 0, 0], T_odom_submap=SE2(1.0, 2.0, 3.0))
    with pytest.raises(InvalidInputError, match="two vehicles of this name"):
        queue.add_submap(other)


def test_withdrawn_submaps_stay_out_when_sent_again_and_come_back_when_restored():
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    before = map_bytes(queue)
    assert queue.withdraw(("auv_2", 0, 1))
    queue.add_submap(dataclasses.replace(FLEET.submaps["auv_2", 0, 1], revision=1))
    answer_all(queue, KnowingMatcher(FLEET))
    states = {r.submap.submap_id: r.state for r in queue.submaps()}
    assert [i for i, s in states.items() if s is SubmapState.WITHDRAWN] == [("auv_2", 0, 1)]
    assert map_bytes(queue) != before
    assert queue.restore(("auv_2", 0, 1))
    answer_all(queue, KnowingMatcher(FLEET))
    assert map_bytes(queue) == before
    assert not queue.withdraw(("auv_9", 0, 0))
    assert not queue.restore(("auv_9", 0, 0))


def test_a_late_vehicle_bridges_two_components():
    """The outer two share nothing; the middle one comes last."""
    queue = filled([i for i in IDS if i[0] != "auv_2"])
    oracle = KnowingMatcher(FLEET, min_overlap=0.25)
    answer_all(queue, oracle)
    assert {r.submap.vehicle_id: r.component for r in queue.submaps()} == {"auv_1": 0, "auv_3": 1}
    for submap_id in IDS:
        if submap_id[0] == "auv_2":
            queue.add_submap(FLEET.submaps[submap_id])
    answer_all(queue, oracle)
    assert {r.component for r in queue.submaps()} == {0}


def test_the_lattice_is_pinned_to_the_first_submap_and_never_moves():
    queue = MapQueue()
    oracle = KnowingMatcher(FLEET)
    spec = FLEET.submaps["auv_3", 0, 0].grid.spec
    for submap_id in [("auv_3", 0, 0), *IDS]:
        queue.add_submap(FLEET.submaps[submap_id])
        for request in queue.next_requests(1):
            queue.add_result(request.request_id, oracle(request))
        fused = queue.global_map()
        shift = fused.spec.T_frame_grid.as_array() - spec.T_frame_grid.as_array()
        cells = shift[:2] / spec.resolution_m
        np.testing.assert_allclose(cells, np.round(cells), atol=1e-9)
        assert shift[2] == 0.0
        anchor = next(r for r in queue.submaps() if r.submap.submap_id == ("auv_3", 0, 0))
        assert anchor.T_component_submap == SE2()


def test_a_lone_submap_is_copied_cell_by_cell():
    queue = filled([("auv_1", 0, 0)])
    submap = FLEET.submaps["auv_1", 0, 0]
    fused = queue.global_map()
    cells = fused.spec.cells_of(submap.grid.spec.centers_of(np.argwhere(submap.grid.known)))
    expected = submap.grid.values[submap.grid.known]
    got = fused.values[cells[:, 0], cells[:, 1]]
    np.testing.assert_array_equal(got >= 50, expected >= 50)
    assert np.count_nonzero(fused.known) == len(cells)


def test_a_cancelled_request_is_asked_again_and_a_late_answer_is_dropped():
    queue = filled()
    first = queue.next_requests(1)[0]
    assert queue.num_in_flight == 1
    queue.cancel_request(first.request_id)
    again = queue.next_requests(1)[0]
    assert (again.source_ids, again.target_ids) == (first.source_ids, first.target_ids)
    assert again.request_id != first.request_id
    queue.add_result(first.request_id, refuse(first))
    assert queue.num_registrations == 0


def test_answers_that_are_corrected_count_as_if_they_had_been_the_first():
    queue, wanted = filled(), filled()
    first, second = KnowingMatcher(FLEET, seed=1), KnowingMatcher(FLEET, seed=2)
    asked = []
    answer_all(queue, lambda request: asked.append(request) or first(request))
    answer_all(wanted, second)
    map_before = map_bytes(queue)
    for request in asked:
        queue.correct_answer(request.key, second(request))
    answer_all(queue, second)
    assert map_bytes(queue) == map_bytes(wanted) != map_before


def test_vehicle_poses_agree_with_the_trajectories():
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    for vehicle, (stamps_ns, poses) in queue.trajectories().items():
        assert (np.diff(stamps_ns) > 0).all()
        newest = max(i for i in IDS if i[0] == vehicle)
        submap = FLEET.submaps[newest]
        last = queue.T_map_odom(vehicle) @ submap.T_odom_submap
        expected = last @ SE2.from_array(submap.trajectory[-1])
        np.testing.assert_allclose(poses[-1], expected.as_array(), atol=1e-9)


def test_constraints_tell_kind_and_residual():
    queue = filled()
    assert {c.kind for c in queue.constraints()} == {ConstraintKind.ODOMETRY}
    answer_all(queue, KnowingMatcher(FLEET))
    constraints = queue.constraints()
    registrations = [c for c in constraints if c.kind is ConstraintKind.REGISTRATION]
    assert len(registrations) >= 2
    assert all(c.is_inlier and c.residual_m < 0.5 for c in registrations)
    assert sum(c.kind is ConstraintKind.ODOMETRY for c in constraints) == len(IDS) - 3


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"vehicle_id": ""}, "empty vehicle_id"),
        ({"sequence": -1}, "sequence -1"),
        ({"covariance": np.full((3, 3), math.nan)}, "covariance is"),
        ({"covariance": np.diag([1.0, 1.0, -1.0])}, "eigenvalue -1"),
        ({"covariance": np.eye(2)}, "expected \\(3, 3\\)"),
        ({"trajectory": np.zeros((1, 3))}, "trajectory has shape"),
        ({"trajectory": np.full((2, 3), math.inf)}, "trajectory holds"),
    ],
)
def test_nonsense_is_refused_by_name(changes, sentence):
    queue = MapQueue()
    with pytest.raises(InvalidInputError, match=sentence):
        queue.add_submap(dataclasses.replace(FLEET.submaps["auv_1", 0, 0], **changes))
    assert queue.submaps() == []
    assert queue.global_map() is None


def test_a_grid_that_is_too_large_is_refused():
    queue = MapQueue(MapQueueConfig(max_submap_cells=100))
    with pytest.raises(InvalidInputError, match="expected at most 100"):
        queue.add_submap(FLEET.submaps["auv_1", 0, 0])


def test_thirty_percent_of_wrong_answers_do_little_harm():
    """Pooled over places; a vehicle that stays out is honest, a false join shows as metres.

    A wrong answer close to the truth, within a small window, cannot be told from noise: a single
    place may come out three times worse.
    """
    clean, wrong = [], []
    num_submaps = num_merged = 0
    for seed in range(12):
        fleet = lawnmower_fleet(4, 6, seed)
        for errors, share in ((clean, 0.0), (wrong, 0.3)):
            queue = filled(fleet=fleet)
            answer_all(queue, KnowingMatcher(fleet, seed, wrong_share=share), 8)
            errors.append(fleet.position_rmse_m(queue))
        num_submaps += len(fleet.submaps)
        num_merged += sum(r.component == 0 for r in queue.submaps())
    assert np.sqrt(np.mean(np.square(wrong))) <= 1.5 * np.sqrt(np.mean(np.square(clean)))
    assert num_merged >= 0.8 * num_submaps


def test_searches_grow_with_the_submaps_and_not_with_their_pairs():
    fleet = lawnmower_fleet(8, 8, 0)
    queue = filled(fleet=fleet)
    num_asked = answer_all(queue, KnowingMatcher(fleet), 8)
    assert {r.component for r in queue.submaps()} == {0}
    assert num_asked <= 64


def test_a_join_outlives_the_larger_question():
    """While a grown map is matched anew, what held before goes on to hold."""
    queue = filled([i for i in IDS if i.sequence < 3])
    oracle = KnowingMatcher(FLEET)
    answer_all(queue, oracle)
    assert {r.component for r in queue.submaps()} == {0}
    queue.add_submap(FLEET.submaps["auv_3", 0, 3])
    assert queue.next_requests(1)
    assert {r.component for r in queue.submaps()} == {0}
    answer_all(queue, refuse)
    assert {r.component for r in queue.submaps()} == {0}


def test_a_false_match_that_no_check_confirms_joins_nothing():
    def lie_at_first(request):
        if request.prior is None:
            return KnowingMatcher(FLEET, wrong_share=1.0)(request)
        return KnowingMatcher(FLEET)(request)

    queue = filled()
    answer_all(queue, lie_at_first)
    assert {r.submap.vehicle_id for r in queue.submaps() if r.component == 0} == {"auv_1"}


def test_an_edge_falls_out_when_others_show_that_it_is_false():
    """Four single submaps; all pairs match, one of them falsely."""
    fleet = lawnmower_fleet(4, 1, 3, lane_m=5.0)
    wrong = frozenset({("auv_01", 0, 0), ("auv_02", 0, 0)})

    def matcher(request):
        share = float(frozenset((*request.source_ids, *request.target_ids)) == wrong)
        return KnowingMatcher(fleet, wrong_share=share)(request)

    queue = filled(sorted(fleet.submaps)[:2], fleet=fleet)
    answer_all(queue, matcher)
    assert fleet.position_rmse_m(queue) > 5.0  # 18 m were seen, and 0.04 m below
    for submap_id in sorted(fleet.submaps)[2:]:
        queue.add_submap(fleet.submaps[submap_id])
    answer_all(queue, matcher)
    assert fleet.position_rmse_m(queue) < 0.1
    outliers = [c for c in queue.constraints() if not c.is_inlier]
    assert {frozenset((c.source, c.target)) for c in outliers} == {wrong}


def test_loops_close_as_well_as_the_edges_are():
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    loops = queue.loops()
    assert loops
    assert all(len(loop.submaps) >= 3 for loop in loops)
    assert all(loop.error_m < 1.0 and loop.error_rad < 0.1 for loop in loops)


def test_a_new_submap_redraws_only_what_it_touches():
    queue = filled([i for i in IDS if i != ("auv_1", 0, 3)])
    queue.global_map()
    queue.changed_window()
    queue.add_submap(FLEET.submaps["auv_1", 0, 3])
    spec, window = queue.changed_window()
    submap = next(r for r in queue.submaps() if r.submap.submap_id == ("auv_1", 0, 3))
    centre = spec.cells_of(submap.T_component_submap.as_array()[None, :2])[0]
    assert np.abs(centre - np.array(spec.shape) / 2).max() <= 2
    assert max(window.shape) <= 2 * FLEET.radius_m / spec.resolution_m + 4
    assert queue.changed_window() is None


def test_answers_that_are_not_sure_enough_alone_join_where_they_all_agree():
    """Refused each by itself; but right by chance, several times over, they cannot be."""

    def unsure(request):
        answer = KnowingMatcher(FLEET)(request)
        if not answer.is_accepted:
            return answer
        return dataclasses.replace(answer, verdict=Verdict.IMPROBABLE, probability=0.7)

    queue = filled()
    answer_all(queue, unsure)
    assert {r.component for r in queue.submaps()} == {0}
    assert FLEET.position_rmse_m(queue) < 0.2
    registrations = [c for c in queue.constraints() if c.kind is ConstraintKind.REGISTRATION]
    assert registrations
    assert all(c.is_unsure for c in registrations)
    reasons = {r.reason for r in queue.submaps() if r.submap.vehicle_id == "auv_2"}
    assert all("unsure alone" in reason for reason in reasons)


def test_only_edges_of_refused_answers_are_marked_unsure():
    def half_sure(request):
        answer = KnowingMatcher(FLEET)(request)
        if request.prior is None or not answer.is_accepted:
            return answer
        return dataclasses.replace(answer, verdict=Verdict.IMPROBABLE, probability=0.7)

    queue = filled()
    answer_all(queue, half_sure)
    refused = {
        frozenset((answer.query.source.reference[0], answer.query.target.reference[0]))
        for answer, is_used in queue.answers()
        if is_used and not answer.is_accepted
    }
    marked = [c for c in queue.constraints() if c.is_unsure]
    assert refused
    assert {frozenset((c.source[0], c.target[0])) for c in marked} == refused
    assert len(marked) == sum(u and not a.is_accepted for a, u in queue.answers())


def test_what_a_false_edge_had_merged_leaves_nothing_behind():
    """The map after it fell out is, byte for byte, one in which it never was believed."""
    fleet = lawnmower_fleet(4, 1, 3, lane_m=5.0)
    ids = sorted(fleet.submaps)

    def matcher(request):
        share = float({*request.source_ids, *request.target_ids} == {ids[0], ids[1]})
        return KnowingMatcher(fleet, wrong_share=share)(request)

    grown = filled(ids[:2], fleet=fleet)
    answer_all(grown, matcher)
    false_spec = grown.global_map().spec
    for submap_id in ids[2:]:
        grown.add_submap(fleet.submaps[submap_id])
    answer_all(grown, matcher)
    whole = filled(fleet=fleet)
    answer_all(whole, matcher)
    assert map_bytes(grown) == map_bytes(whole)
    assert grown.global_map().spec != false_spec
    assert fleet.position_rmse_m(grown) < 0.1


def test_loops_are_measured_in_metres_and_radians():
    """A cycle with one edge that is off by a known amount fails to close by that amount."""
    exact = np.diag([1e-4, 1e-4, 1e-6])
    odometry = [Edge(("a", 1), ("a", 0), SE2(4.0, 0.0, 0.5), exact)]
    constraints = [
        Constraint((b"1", b"", ()), Edge(("b", 0), ("a", 0), SE2(1.0, 2.0, 0.3), exact), 0.99),
        Constraint(
            (b"2", b"", ()),
            Edge(
                ("b", 0),
                ("a", 1),
                SE2(4.0, 0.0, 0.5).inverse() @ SE2(1.0, 2.0, 0.3) @ SE2(0.3, 0.4, 0.1),
                exact,
            ),
            0.9,
        ),
    ]
    (loop,) = loop_errors(odometry, constraints)
    assert set(loop.submaps) == {("a", 0), ("a", 1), ("b", 0)}
    assert loop.error_rad == pytest.approx(0.1)
    assert loop.error_m == pytest.approx(0.5, abs=0.15)
