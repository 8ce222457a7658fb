import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import room_map
from unit.link.talk import Talk
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding import answers
from uw_dslam_ros2.core.link.coding.answers import AnswerExchange, decode_answer, encode_answer
from uw_dslam_ros2.core.link.transport.packets import OVERHEAD_BYTES
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, make_result

QUESTION = answers.question_digest(room_map(), room_map())


@given(st.floats(-500, 500), st.floats(-500, 500), st.floats(-3.1, 3.1), st.floats(0, 1))
def test_an_answer_takes_some_thirty_bytes_and_keeps_its_pose(x, y, yaw, probability):
    result = dataclasses.replace(make_result(SE2(x, y, yaw)), probability=probability)
    data = encode_answer(QUESTION, result)
    assert len(data) + OVERHEAD_BYTES <= 32
    question, got = decode_answer(data)
    off_m, off_rad = got.T_target_source.distance_to(result.T_target_source)
    assert question == QUESTION
    assert off_m < 0.001
    assert off_rad < 1e-5
    assert got.verdict is result.verdict
    assert probability - 0.004 <= got.probability <= probability + 1e-9
    assert (np.diag(got.covariance) >= np.diag(result.covariance) * (1 - 1e-6)).all()
    assert encode_answer(QUESTION, got) == data  # coded once or often, it is the same


def test_a_refusal_is_shorter():
    refused = RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "no walls")
    data = encode_answer(QUESTION, refused)
    assert len(data) == 7
    _, got = decode_answer(data)
    assert (got.verdict, got.T_target_source) == (Verdict.TOO_FEW_FEATURES, None)


def test_a_question_is_its_content():
    one, turned = room_map(), room_map(T_frame_grid=SE2(0.0, 0.0, 0.1))
    prior = PriorWindow(SE2(1.0, 2.0, 0.3), 2.0, 0.2)
    wider = PriorWindow(SE2(1.0, 2.0, 0.3), 2.5, 0.2)
    asked = [
        answers.question_digest(*maps, window)
        for maps in ((one, one), (one, turned), (turned, one))
        for window in (None, prior, wider)
    ]
    assert len(set(asked)) == 9
    assert answers.question_digest(room_map(), room_map()) == QUESTION


@given(st.binary(max_size=40))
def test_noise_is_no_answer_or_a_harmless_one(data):
    try:
        _, got = decode_answer(data)
    except InvalidInputError:
        return
    if got.T_target_source is None:
        assert got.verdict is not Verdict.ACCEPTED
    else:
        assert math.isfinite(got.T_target_source.x)
        assert np.linalg.eigvalsh(got.covariance)[0] >= -1e-9 * np.abs(got.covariance).max()


def test_of_two_answers_all_take_the_same():
    one, other = (encode_answer(QUESTION, make_result(SE2(x, 0.0, 0.0))) for x in (1.0, 1.001))
    poses = []
    for order in ((one, other), (other, one)):
        exchange = AnswerExchange()
        for data in order:
            exchange.take(data)
        poses.append(exchange.find(QUESTION).T_target_source)
    assert poses[0] == poses[1]


def test_who_hears_the_answers_need_not_search_and_has_the_same_map():
    fleet = three_vehicles(num_submaps=3)
    talk = Talk(num=2)
    maps, searched = [], []
    for number in (1, 2):  # one after the other: the second has heard all of the first's
        talk.run(talk.now_s + 300.0)
        exchange = AnswerExchange()
        for data in talk.links[number].take_answers():
            exchange.take(data)
        matcher = KnowingMatcher(fleet, seed=number)  # its digits are its own

        def answer(request, exchange=exchange, matcher=matcher, link=talk.links[number]):
            asked = answers.question_digest(request.source, request.target, request.prior)
            if (found := exchange.find(asked)) is None:
                found = exchange.settle(asked, matcher(request))
                link.add_answer(exchange.data(asked))
            return found

        queue = MapQueue(MapQueueConfig(anchor_vehicle="auv_1"))
        for submap in fleet.submaps.values():
            queue.add_submap(submap)
        answer_all(queue, answer)
        maps.append(map_bytes(queue))
        searched.append(matcher.num_asked)
    assert searched[0] > 3
    assert searched[1] == 0
    assert maps[0] == maps[1]


def test_an_accepted_answer_without_a_pose_is_refused():
    with pytest.raises(InvalidInputError, match="no pose"):
        decode_answer(QUESTION + bytes([2 * Verdict.ACCEPTED]))
