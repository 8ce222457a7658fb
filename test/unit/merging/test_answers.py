"""What the queue does with an answer, by its verdict, its numbers and where it lies."""

import math
from dataclasses import replace

import numpy as np
import pytest
from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, Use
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.sessions.session import load_session, save_session
from uw_dslam_ros2.sim.maps.fleets import make_result

SIDES = [SubmapGroup((name, 0), {(name, 0): SE2()}, name.encode()) for name in ("auv_1", "auv_2")]
EVERYWHERE = Query(*SIDES)
NEAR = Query(*SIDES, PriorWindow(SE2(1.0, 2.0, 0.5), 1.0, 0.2))
FOUND = replace(make_result(SE2(1.0, 2.0, 0.5)), reason="because")


def answer(query=EVERYWHERE, **changes):
    return Answer.of(query, replace(FOUND, **changes))


@pytest.mark.parametrize(
    ("verdict", "probability", "use"),
    [
        (Verdict.ACCEPTED, 0.8, Use.EDGE),
        (Verdict.IMPROBABLE, 0.6, Use.CLAIM),
        (Verdict.IMPROBABLE, 0.4, Use.VOTE),
        (Verdict.NOT_ENOUGH_OVERLAP, 0.6, Use.CLAIM),
        (Verdict.NOT_ENOUGH_OVERLAP, 0.0, Use.VOTE),
        (Verdict.AMBIGUOUS, 0.9, Use.NOTHING),
        (Verdict.CONTRADICTED, 0.9, Use.NOTHING),
        (Verdict.BUDGET_EXHAUSTED, 0.9, Use.NOTHING),
        (Verdict.TOO_FEW_FEATURES, 0.9, Use.NOTHING),
    ],
)
@pytest.mark.parametrize("query", [EVERYWHERE, NEAR], ids=["everywhere", "near"])
def test_the_verdict_says_what_an_answer_is_good_for(verdict, probability, use, query):
    given = answer(query, verdict=verdict, probability=probability)
    assert given.use is use
    assert given.is_accepted is (verdict is Verdict.ACCEPTED)
    assert given.why == "because"


def test_all_verdicts_are_in_that_table():
    table = test_the_verdict_says_what_an_answer_is_good_for.pytestmark[1].args[1]
    assert {verdict for verdict, *_ in table} == set(Verdict)


@pytest.mark.parametrize("verdict", list(Verdict))
def test_an_answer_outside_its_window_is_of_no_use(verdict):
    given = answer(NEAR, verdict=verdict, T_target_source=SE2(3.0, 2.0, 0.5))
    assert given.use is Use.NOTHING
    assert "outside the window" in given.why


@pytest.mark.parametrize("verdict", list(Verdict))
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["probability", "covariance"])
def test_an_answer_that_is_not_finite_is_of_no_use(verdict, name, bad):
    value = np.full((3, 3), bad) if name == "covariance" else bad
    given = answer(verdict=verdict, **{name: value})
    assert given.use is Use.NOTHING
    if verdict in (Verdict.ACCEPTED, Verdict.IMPROBABLE):
        assert "not finite" in given.why


def test_an_answer_without_a_pose_is_of_no_use():
    refused = RegistrationResult.refused(Verdict.IMPROBABLE, "because")
    for query in (EVERYWHERE, NEAR):
        assert Answer.of(query, refused).use is Use.NOTHING


def test_refusals_survive_a_session(tmp_path):
    fleet, queue = three_vehicles(), MapQueue()
    for submap_id in sorted(fleet.submaps):
        queue.add_submap(fleet.submaps[submap_id])
    results = [
        RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "few"),
        replace(FOUND, verdict=Verdict.IMPROBABLE),
    ]
    for request, result in zip(queue.next_requests(2), results, strict=True):
        queue.add_result(request.request_id, result)
    save_session(tmp_path, queue)
    before, after = (
        {a.query.key: a for a, _ in q.answers()} for q in (queue, load_session(tmp_path))
    )
    assert len(before) == 2
    assert set(before) == set(after)
    for key, given in before.items():
        again = after[key]
        assert (again.verdict, again.use, again.why) == (given.verdict, given.use, given.why)
        assert again.T_target_source == given.T_target_source
        np.testing.assert_array_equal(again.covariance, given.covariance)
