"""The registration server from a client's side: two at once, cancels, large maps, limits.

``python benchmarks/bench_server.py [CASE ...] [--quick]`` prints one JSON line per measurement.
The server is a process of its own, as in use; the client talks to it over ROS, on this machine
only.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import rclpy
from harness import Timing, emit, require, run_cases
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from uw_dslam_msgs.action import RegisterMaps as RegisterMapsAction
from uw_dslam_msgs.msg import Registration
from uw_dslam_msgs.srv import RegisterMaps

from uw_dslam_ros2.ros.convert.core_types import occupancy_to_msg
from uw_dslam_ros2.sim.maps.pairs import MapPair, make_pair

_DOMAIN_ID = 77
_START = "from uw_dslam_ros2.ros.nodes.registration_server import main; raise SystemExit(main())"
_NAME = "/registration_server/register_maps"
_TIMEOUT_S = 300.0
_Response = RegisterMaps.Response


class _Client:
    """A node that asks, and waits."""

    def __init__(self, node: Node, server: subprocess.Popen[bytes]) -> None:
        self._server = server
        self.service = node.create_client(RegisterMaps, _NAME)
        self.action = ActionClient(node, RegisterMapsAction, _NAME)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def until(self, is_true: Callable[[], bool], what: str) -> None:
        end_s = time.monotonic() + _TIMEOUT_S
        while not is_true():
            require(time.monotonic() < end_s, f"no {what} within {_TIMEOUT_S:.0f} s")
            require(self._server.poll() is None, "the server is gone")
            self._executor.spin_once(timeout_sec=0.005)

    def ask(self, requests: list[RegisterMaps.Request], at_once: int) -> tuple[list[Any], float]:
        """Answers to all requests, so many of them under way at a time; and the seconds."""
        begun_s, waiting, running, answers = time.monotonic(), list(requests), [], []
        while waiting or running:
            while waiting and len(running) < at_once:
                running.append(self.service.call_async(waiting.pop(0)))
            self.until(lambda under_way=running: any(f.done() for f in under_way), "answer")
            answers += [future.result() for future in running if future.done()]
            running = [future for future in running if not future.done()]
        return answers, time.monotonic() - begun_s


@contextlib.contextmanager
def _server(**parameters: Any) -> Iterator[_Client]:
    """A server with such parameters, and a client to it."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(_DOMAIN_ID)
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    # One thread a search: OpenCV's own would hide what two searches at once gain.
    process = subprocess.Popen(
        [sys.executable, "-c", _START, "--ros-args", *given],
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=_DOMAIN_ID)
    node = rclpy.create_node("bench", context=context)
    try:
        client = _Client(node, process)
        client.until(client.service.service_is_ready, "service")
        client.until(client.action.server_is_ready, "action server")
        yield client
    finally:
        node.destroy_node()
        context.try_shutdown()
        process.send_signal(signal.SIGINT)
        process.wait(timeout=30.0)


@functools.cache
def _pair(size_cells: int, seed: int = 5) -> MapPair:
    return make_pair("harbour", 0.6, "noisy", seed, size_cells=size_cells)


def _request(size_cells: int, seed: int = 5) -> RegisterMaps.Request:
    return _request_of(_pair(size_cells, seed))


def _request_of(pair: MapPair) -> RegisterMaps.Request:
    source, target = (occupancy_to_msg(m, "map", 0) for m in (pair.source, pair.target))
    return RegisterMaps.Request(source=source, target=target)


def _require_right(answer: Any, size_cells: int, seed: int = 5) -> None:
    require(answer.result == _Response.DONE, f"the server says: {answer.message}")
    registration = answer.registration
    require(registration.verdict == Registration.ACCEPTED, registration.reason)
    truth, found = _pair(size_cells, seed).T_target_source, registration.t_target_source
    error = math.hypot(found.x - truth.x, found.y - truth.y)
    # The frames lie up to 70 m from the maps.
    require(error < 1.0, f"{error:.2f} m off")


def two_at_once(quick: bool) -> None:
    """Throughput of two requests under way over that of one; asked is 1.6 or more on two cores."""
    seeds = range(5, 7) if quick else range(5, 11)
    requests = [_request(600, seed) for seed in seeds]
    with _server(max_parallel=2) as client:
        client.ask(requests[:1], 1)  # imports and kernels
        ratios, one_s, two_s = [], Timing(), Timing()
        for _ in range(1 if quick else 3):
            for timing, at_once in ((one_s, 1), (two_s, 2)):
                answers, seconds = client.ask(requests, at_once)
                require(all(a.result == _Response.DONE for a in answers), "a request was refused")
                timing.add(seconds, 0.0)
            ratios.append(one_s.wall_s[-1] / two_s.wall_s[-1])
    values = {"requests": len(requests), "throughput_ratio": float(np.median(ratios))}
    emit("two_at_once", {**values, "one_s": one_s.wall_s[-1], "two_s": two_s.wall_s[-1]})


def cancel(quick: bool) -> None:
    """From asking for a cancel to the result; asked are 100 ms for 95 % of them."""
    rng, latencies_s, num_feedback, watched_s = np.random.default_rng(0), [], 0, 0.0
    parameters = {"registration.gap": 0.001, "registration.max_boxes": 100_000_000}
    with _server(**parameters) as client:
        # Little in common, and a small gap: seconds of search.
        request = _request_of(make_pair("office", 0.3, "noisy", 5, size_cells=400))
        goal = RegisterMapsAction.Goal(source=request.source, target=request.target)
        _, whole_s = client.ask([request], 1)
        for _ in range(3 if quick else 20):
            arrivals: list[float] = []
            sent = client.action.send_goal_async(
                goal, feedback_callback=lambda _, a=arrivals: a.append(time.monotonic())
            )
            client.until(sent.done, "acceptance")
            done = sent.result().get_result_async()
            begun_s, wait_s = time.monotonic(), float(rng.uniform(0.1, 0.7)) * whole_s
            client.until(lambda b=begun_s, w=wait_s: time.monotonic() > b + w, "time")
            num_feedback += len(arrivals)
            watched_s += time.monotonic() - begun_s
            asked_s = time.monotonic()
            require(not done.done(), "the search was over before the cancel")
            sent.result().cancel_goal_async()
            client.until(done.done, "result")
            latencies_s.append(time.monotonic() - asked_s)
            verdict = done.result().result.registration.verdict
            require(verdict == Registration.BUDGET_EXHAUSTED, f"verdict {verdict} after a cancel")
    values = {"cancels": len(latencies_s), "feedback_per_s": num_feedback / watched_s}
    p50_s, p95_s = np.percentile(latencies_s, [50, 95])
    emit("cancel", {**values, "median_s": p50_s, "p95_s": p95_s, "most_s": max(latencies_s)})


def large_maps(quick: bool) -> None:
    """Maps of 2000 x 2000 and 4000 x 4000 cells through the service; asked: 1 s for the first."""
    with _server() as client:
        client.ask([_request(400)], 1)
        for size in (2000,) if quick else (2000, 4000):
            asked, inside = Timing(), []
            for _ in range(2 if quick else 5):
                (answer,), seconds = client.ask([_request(size)], 1)
                _require_right(answer, size)
                asked.add(seconds, 0.0)
                inside.append(answer.registration.seconds)
            values = {"size_cells": size, "search_median_s": float(np.median(inside))}
            emit("large_maps", {**values, "request_median_s": float(np.median(asked.wall_s))})


def limits(_quick: bool) -> None:
    """What is refused, how soon, and in what words: too many requests, too many cells."""
    with _server(max_parallel=1, max_waiting=1, max_cells=1_000_000) as client:
        client.ask([_request(400)], 1)
        answers, _ = client.ask([_request(400)] * 5, 5)
        busy = [a for a in answers if a.result == _Response.BUSY]
        require(len(busy) == 3, f"{len(busy)} of 5 requests were refused, expected 3")
        (answer,), seconds = client.ask([_request(2000)], 1)
        require(answer.result == _Response.INVALID_INPUT, "a map beyond the limit was taken")
        words = {"busy": busy[0].message, "too_large": answer.message}
        emit("limits", {**words, "refused_after_s": seconds})


if __name__ == "__main__":
    cases = {c.__name__: c for c in (two_at_once, cancel, large_maps, limits)}
    sys.exit(run_cases(__doc__ or "", cases))
