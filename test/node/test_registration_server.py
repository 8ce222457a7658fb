"""The registration server from a client's side: answers, refusals, feedback, cancel, load."""

import array
import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from places import room_map
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from uw_dslam_msgs.action import RegisterMaps as RegisterMapsAction
from uw_dslam_msgs.msg import Registration, RegistrationOptions
from uw_dslam_msgs.srv import RegisterMaps, RegisterPointSets

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration import register_grids
from uw_dslam_ros2.core.registration.result import Progress, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import occupancy_to_msg
from uw_dslam_ros2.ros.nodes import registration_server
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.plumbing.qos import SERVICES

pytestmark = pytest.mark.ros

Response = RegisterMaps.Response


@pytest.fixture
def serve(ros_context, spinning):
    """``serve(settings) as (until, probe)``: a server and a probe node, spinning."""
    import contextlib

    @contextlib.contextmanager
    def run(**settings):
        parameters = [Parameter(name, value=value) for name, value in settings.items()]
        server = RegistrationServer(context=ros_context, parameter_overrides=parameters)
        probe = rclpy.create_node("probe", context=ros_context)
        with spinning(server, probe) as until:
            yield until, probe

    return run


def connected(until, probe, service_type, name):
    client = probe.create_client(service_type, f"/registration_server/{name}")
    until(client.service_is_ready, f"service {name}")
    return client


def answered(until, client, request):
    future = client.call_async(request)
    until(future.done, "an answer")
    return future.result()


def map_msg(occupancy=None):
    return occupancy_to_msg(occupancy or room_map(), "somewhere", 0)


class Gate:
    """A search that runs until it is opened or cancelled, and tells what it was asked."""

    def __init__(self, *, is_obedient=True):
        self.opened = threading.Event()
        self.is_obedient = is_obedient
        self.threads = set()
        self.num_running = 0
        self.most_running = 0
        self._lock = threading.Lock()

    def __call__(self, *_, progress, is_cancelled, **__):
        with self._lock:
            self.num_running += 1
            self.most_running = max(self.most_running, self.num_running)
        num_boxes = 0
        while not self.opened.is_set() and not (self.is_obedient and is_cancelled()):
            num_boxes += 1
            progress(Progress("search", 0.5, 0.9, num_boxes, 7, SE2(1.0, 2.0, 0.5)))
            self.opened.wait(0.005)
        with self._lock:
            self.num_running -= 1
        return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "the gate was opened")


@pytest.fixture
def gate(monkeypatch):
    gate = Gate()
    monkeypatch.setattr(registration_server, "register_grids", gate)
    yield gate
    gate.opened.set()


def test_same_room_seen_from_elsewhere_is_found(serve):
    T_target_source = SE2(3.0, -2.0, 0.7)
    source = room_map()
    target = room_map(T_frame_grid=T_target_source)  # the same cells, their frame elsewhere
    with serve() as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        request = RegisterMaps.Request(source=map_msg(source), target=map_msg(target))
        response = answered(until, client, request)
    assert (response.result, response.message) == (Response.DONE, "")
    assert response.registration.verdict == Registration.ACCEPTED, response.registration.reason
    found = response.registration.t_target_source
    distance_m, angle_rad = SE2(found.x, found.y, found.yaw).distance_to(T_target_source)
    assert distance_m < 1e-3
    assert angle_rad < 1e-4
    assert response.registration.seconds > 0.0


def test_searches_side_by_side_find_what_each_finds_alone(serve):
    """They share kernels and threads, and nothing else."""
    target = room_map()
    sources = [room_map(T_frame_grid=SE2(k, -2.0 * k, 0.3 * k)) for k in range(4)]
    alone = [register_grids(source, target) for source in sources]
    with serve(max_parallel=2, max_waiting=2) as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        futures = [
            client.call_async(RegisterMaps.Request(source=map_msg(s), target=map_msg(target)))
            for s in sources
        ]
        until(lambda: all(future.done() for future in futures), "all answers")
    for future, expected in zip(futures, alone, strict=True):
        found = future.result().registration
        assert found.verdict == expected.verdict
        assert found.num_boxes == expected.num_boxes
        assert found.lower_bound == expected.lower_bound
        T_found = SE2(found.t_target_source.x, found.t_target_source.y, found.t_target_source.yaw)
        distance_m, angle_rad = T_found.distance_to(expected.T_target_source)
        assert distance_m < 1e-3  # a message's origin has another precision than a map's
        assert angle_rad < 1e-4


@pytest.mark.parametrize("max_waiting", [2, 40])
def test_every_request_of_a_burst_is_answered(serve, gate, max_waiting):
    """More at once than DDS keeps by default: each is searched, or told to come again."""
    with serve(max_parallel=1, max_waiting=max_waiting) as (until, probe):
        client = probe.create_client(
            RegisterMaps, "/registration_server/register_maps", qos_profile=SERVICES
        )
        until(client.service_is_ready, "the service")
        request = RegisterMaps.Request(source=map_msg(), target=map_msg())
        futures = [client.call_async(request) for _ in range(40)]
        until(lambda: gate.num_running, "the first search")
        gate.opened.set()
        until(lambda: all(future.done() for future in futures), "all answers")
    results = [future.result().result for future in futures]
    assert results.count(Response.DONE) >= 1
    if max_waiting >= len(futures):
        assert results == [Response.DONE] * len(futures)
    else:
        assert set(results) <= {Response.DONE, Response.BUSY}


def test_point_sets_are_aligned(serve, rng):
    T_target_source = SE2(1.0, -2.0, 0.5)
    source = rng.uniform(-5.0, 5.0, (40, 2))
    target = T_target_source.apply(source)
    with serve() as (until, probe):
        client = connected(until, probe, RegisterPointSets, "register_point_sets")
        request = RegisterPointSets.Request(sigma_m=0.05)
        request.source = [Point(x=float(x), y=float(y)) for x, y in source]
        request.target = [Point(x=float(x), y=float(y)) for x, y in target]
        response = answered(until, client, request)
        assert response.result == RegisterPointSets.Response.DONE
        found = response.registration.t_target_source
        distance_m, _ = SE2(found.x, found.y, found.yaw).distance_to(T_target_source)
        assert distance_m < 0.05
        request.source[3].x = float("nan")
        response = answered(until, client, request)
        assert response.result == RegisterPointSets.Response.INVALID_INPUT
        assert "source[3]" in response.message
        request.source[3].x, request.sigma_m = 0.0, -1.0
        response = answered(until, client, request)
        assert response.result == RegisterPointSets.Response.INVALID_INPUT
        assert "sigma_m" in response.message


def damaged_maps():
    def change(path, value):
        msg = map_msg()
        *owners, name = path.split(".")
        owner = msg
        for part in owners:
            owner = getattr(owner, part)
        setattr(owner, name, value)
        return msg

    def uniform(value):
        return map_msg(OccupancyMap(GridSpec(0.1, 50, 60), np.full((50, 60), value, np.int8)))

    wall = np.zeros((50, 60), np.int8)
    wall[25] = 100
    return {
        "zero width": (change("info.width", 0), "source.info.width is 0"),
        "zero height": (change("info.height", 0), "source.info.height is 0"),
        "short data": (change("data", array.array("b", [0] * 7)), "source.data has 7 values"),
        "NaN origin": (
            change("info.origin.position.x", float("nan")),
            "source.info.origin.position.x is nan",
        ),
        "resolution 0": (change("info.resolution", 0.0), "source.info.resolution is 0.0"),
        "resolution < 0": (change("info.resolution", -1.0), "source.info.resolution is -1.0"),
        "no rotation": (change("info.origin.orientation.w", 0.0), "orientation"),
        "value 101": (uniform(0), "source.data holds 101"),
        "too many cells": (change("info.width", 10_000_000), "max_cells"),
        "all unknown": (uniform(-1), None),
        "all occupied": (uniform(100), None),
        "all free": (uniform(0), None),
        "one wall": (map_msg(OccupancyMap(GridSpec(0.1, 50, 60), wall)), None),
        "one cell": (map_msg(OccupancyMap(GridSpec(0.1, 1, 1), np.zeros((1, 1), np.int8))), None),
    }


def test_every_damage_gets_its_own_sentence_and_the_server_lives(serve):
    sentences = {}
    with serve() as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        for name, (source, words) in damaged_maps().items():
            if name == "value 101":
                source.data[5] = 101
            request = RegisterMaps.Request(source=source, target=map_msg())
            request.options.max_seconds = 2.0
            response = answered(until, client, request)
            if words is None:  # a map that is whole, but cannot be matched: a verdict says so
                assert response.result == Response.DONE, (name, response.message)
                assert response.registration.verdict != Registration.ACCEPTED, name
                sentences[name] = response.registration.reason
            else:
                assert response.result == Response.INVALID_INPUT, name
                assert words in response.message
                sentences[name] = response.message
    assert all(sentences.values())
    assert len(set(sentences.values())) == len(sentences)


def test_bad_options_are_refused(serve):
    with serve() as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        options = RegistrationOptions(has_prior=True, prior_half_width_m=0.0)
        request = RegisterMaps.Request(source=map_msg(), target=map_msg(), options=options)
        response = answered(until, client, request)
    assert response.result == Response.INVALID_INPUT
    assert "prior_half_width_m is 0.0" in response.message


def test_an_error_of_the_engine_is_an_answer(serve, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("inside")

    monkeypatch.setattr(registration_server, "register_grids", broken)
    with serve() as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        request = RegisterMaps.Request(source=map_msg(), target=map_msg())
        for _ in range(2):
            response = answered(until, client, request)
            assert response.result == Response.FAILED
            assert response.message == "ZeroDivisionError: inside"


def test_too_many_requests_are_refused_and_the_rest_run_side_by_side(serve, gate):
    with serve(max_parallel=2, max_waiting=1) as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        request = RegisterMaps.Request(source=map_msg(), target=map_msg())
        futures = [client.call_async(request) for _ in range(4)]
        until(lambda: any(future.done() for future in futures), "a refusal")
        refused = [future.result() for future in futures if future.done()]
        assert [response.result for response in refused] == [Response.BUSY]
        assert "3 registrations" in refused[0].message
        until(lambda: gate.num_running == 2, "two searches")
        gate.opened.set()
        until(lambda: all(future.done() for future in futures), "all answers")
        assert sorted(f.result().result for f in futures) == [1, 1, 1, Response.BUSY]
    assert gate.most_running == 2


def test_parameter_services_answer_while_searches_run(serve, gate):
    with serve(max_parallel=1, max_waiting=2) as (until, probe):
        client = connected(until, probe, RegisterMaps, "register_maps")
        futures = [
            client.call_async(RegisterMaps.Request(source=map_msg(), target=map_msg()))
            for _ in range(3)
        ]
        until(lambda: gate.num_running == 1, "a search")
        parameters = connected(until, probe, GetParameters, "get_parameters")
        response = answered(until, parameters, GetParameters.Request(names=["max_parallel"]))
        assert response.values[0].integer_value == 1
        assert not any(future.done() for future in futures)


def test_diagnostics_tell_load_and_latencies(serve, gate):
    seen = []
    with serve() as (until, probe):
        probe.create_subscription(DiagnosticArray, "/diagnostics", seen.append, 10)
        client = connected(until, probe, RegisterMaps, "register_maps")
        future = client.call_async(RegisterMaps.Request(source=map_msg(), target=map_msg()))

        def value(key):
            values = {v.key: v.value for msg in seen[-1:] for v in msg.status[0].values}
            return values.get(key)

        until(lambda: value("num_running") == "1", "a status of a running search")
        gate.opened.set()
        until(lambda: value("latency_median_s") is not None, "a latency")
        assert value("num_budget_exhausted") == "1"
        assert future.done()


def start_goal(until, probe, on_feedback=None):
    client = ActionClient(probe, RegisterMapsAction, "/registration_server/register_maps")
    until(client.server_is_ready, "the action server")
    goal = RegisterMapsAction.Goal(source=map_msg(), target=map_msg())
    sent = client.send_goal_async(goal, feedback_callback=on_feedback)
    until(sent.done, "acceptance")
    return client, sent.result()


def test_action_tells_the_bounds_at_least_twice_a_second(serve, gate):
    arrivals = []

    def on_feedback(msg):
        arrivals.append((time.monotonic(), msg.feedback))

    with serve() as (until, probe):
        client, handle = start_goal(until, probe, on_feedback)
        until(lambda: len(arrivals) >= 6, "feedback")
        gate.opened.set()
        done = handle.get_result_async()
        until(done.done, "the result")
        assert done.result().result.result == RegisterMapsAction.Result.DONE
        client.destroy()
    gaps_s = np.diff([arrival_s for arrival_s, _ in arrivals])
    assert np.median(gaps_s) <= 0.5
    newest = arrivals[-1][1]
    assert (newest.stage, newest.lower_bound, newest.upper_bound) == ("search", 0.5, 0.9)
    assert newest.gap == pytest.approx(4 / 9)
    assert newest.num_boxes > arrivals[1][1].num_boxes
    assert newest.seconds > 0.0
    assert newest.t_target_source.x == 1.0


@pytest.mark.parametrize("is_obedient", [True, False])
def test_cancel_is_answered_with_the_best_so_far(serve, gate, is_obedient):
    """Also when the search does not look up for long: it is left behind."""
    gate.is_obedient = is_obedient
    feedback = []
    with serve() as (until, probe):
        client, handle = start_goal(until, probe, feedback.append)
        until(lambda: feedback and feedback[-1].feedback.stage == "search", "feedback")
        done = handle.get_result_async()
        asked_s = time.monotonic()
        cancelled = handle.cancel_goal_async()
        until(done.done, "the result")
        took_s = time.monotonic() - asked_s
        until(cancelled.done, "the cancel's answer")
        registration = done.result().result.registration
        assert registration.verdict == Registration.BUDGET_EXHAUSTED
        if not is_obedient:
            assert (registration.lower_bound, registration.upper_bound) == (0.5, 0.9)
            assert registration.t_target_source.y == 2.0
        assert took_s < 1.0  # 0.1 s on an idle machine; tests run on busy ones
        gate.opened.set()
        client.destroy()


def test_action_speaks_before_the_search_does(serve, monkeypatch):
    """While features are made, nothing is proven: the bounds are 0 and 1, and there is no pose."""
    opened = threading.Event()

    def silent(*_, **__):
        opened.wait(30.0)
        return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "done")

    monkeypatch.setattr(registration_server, "register_grids", silent)
    feedback = []
    with serve() as (until, probe):
        client, handle = start_goal(until, probe, feedback.append)
        until(lambda: len(feedback) >= 2, "feedback")
        opened.set()
        done = handle.get_result_async()
        until(done.done, "the result")
        client.destroy()
    first = feedback[0].feedback
    assert (first.stage, first.lower_bound, first.upper_bound, first.gap) == ("features", 0, 1, 1)
    assert np.isnan(first.t_target_source.x)


def test_goal_beyond_the_limit_is_aborted_with_the_reason(serve, gate):
    with serve(max_parallel=1, max_waiting=0) as (until, probe):
        first, _ = start_goal(until, probe)
        until(lambda: gate.num_running == 1, "a search")
        second, handle = start_goal(until, probe)
        done = handle.get_result_async()
        until(done.done, "the refusal")
        assert done.result().result.result == RegisterMapsAction.Result.BUSY
        assert "1 registrations" in done.result().result.message
        gate.opened.set()
        until(lambda: gate.num_running == 0, "the end")
        first.destroy()
        second.destroy()


def test_a_typing_error_in_a_setting_is_refused(ros_context):
    with pytest.raises(ConfigError, match=r"registration.gpa is unknown.*registration.gap"):
        RegistrationServer(
            context=ros_context, parameter_overrides=[Parameter("registration.gpa", value=0.1)]
        )
