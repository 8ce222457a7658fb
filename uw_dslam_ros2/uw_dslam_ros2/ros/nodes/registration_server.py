"""Aligns maps for whoever asks: two services, and an action that tells how the proof goes."""

from __future__ import annotations

import functools
import math
import os
import socket
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from uw_dslam_msgs.action import RegisterMaps as RegisterMapsAction
from uw_dslam_msgs.srv import RegisterMaps, RegisterPointSets

from uw_dslam_ros2.core.config import Config
from uw_dslam_ros2.core.errors import ConfigError, InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration import (
    GridRegistrationConfig,
    RegistrationConfig,
    register_grids,
    register_point_sets,
)
from uw_dslam_ros2.core.registration.result import Progress, RegistrationResult, Verdict
from uw_dslam_ros2.ros.convert.core_types import occupancy_from_msg, transform2d_to_msg
from uw_dslam_ros2.ros.convert.registration import options_from_msg, registration_to_msg
from uw_dslam_ros2.ros.plumbing.diagnostics import Report
from uw_dslam_ros2.ros.plumbing.managed_node import ManagedNode
from uw_dslam_ros2.ros.plumbing.node_settings import RegistrationServerConfig
from uw_dslam_ros2.ros.plumbing.qos import SERVICES
from uw_dslam_ros2.ros.plumbing.registration_jobs import Job, RegistrationJobs, Search
from uw_dslam_ros2.ros.plumbing.running import run_node

__all__ = ["RegistrationServer", "RegistrationServerConfig", "main"]

_FEEDBACK_PERIOD_S = 0.25
_POLL_S = 0.01
_CANCEL_PATIENCE_S = 0.02
_NUM_LATENCIES = 200
_SWITCH_INTERVAL_S = 2e-4


class RegistrationServer(ManagedNode):
    """Services ``~/register_maps`` and ``~/register_point_sets``, action ``~/register_maps``.

    While it is not active, who asks is told that it is busy.
    """

    groups = (
        ("", RegistrationServerConfig),
        ("registration", GridRegistrationConfig),
        ("points", RegistrationConfig),
    )
    live = frozenset({"max_cells", "max_points", "registration.*", "points.*"})
    why_fixed = "its threads are started with it"
    _action: ActionServer | None = None

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("registration_server", **kwargs)

    def set_up(self) -> None:
        """Make threads, services and the action."""
        self._config = self.settings(RegistrationServerConfig)
        self._jobs = RegistrationJobs(self._config.max_parallel, self._config.max_waiting)
        self.at_end(self._jobs.close)  # whoever waits for a search gets an answer
        self.num_threads = self._jobs.max_accepted + 4
        self._statistics = _Statistics()
        group = ReentrantCallbackGroup()
        for service_type, name, serve in (
            (RegisterMaps, "~/register_maps", self._on_register_maps),
            (RegisterPointSets, "~/register_point_sets", self._on_register_point_sets),
        ):
            self.create_service(
                service_type, name, serve, qos_profile=SERVICES, callback_group=group
            )
        if self._action is None:
            self._action = self._make_action(group)
        # New with every start: whoever waits for an answer sees that its server is gone.
        instance = f"{socket.gethostname()}:{os.getpid()}:{time.time_ns()}"
        self.tell_health(self._report, instance)

    def _make_action(self, group: ReentrantCallbackGroup) -> ActionServer:
        """Once: an executor that waits for goals does not survive the end of their server."""
        return ActionServer(
            self,
            RegisterMapsAction,
            "~/register_maps",
            self._execute,
            goal_callback=lambda _: GoalResponse.ACCEPT if self.is_active else GoalResponse.REJECT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
            goal_service_qos_profile=SERVICES,
            result_service_qos_profile=SERVICES,
            cancel_service_qos_profile=SERVICES,
        )

    def destroy_node(self) -> None:
        """Stop, then destroy."""
        self.stop()
        if self._action is not None:
            self._action.destroy()
        super().destroy_node()

    def begin(self) -> None:
        """Take requests."""
        self.get_logger().info(f"serving, {self._jobs.max_parallel} searches at a time")

    def settings_changed(self) -> None:
        """From the next request on."""
        self._config = self.settings(RegistrationServerConfig)

    # --- services ----------------------------------------------------------------------------

    def _on_register_maps(
        self, request: RegisterMaps.Request, response: RegisterMaps.Response
    ) -> RegisterMaps.Response:
        return self._answer(lambda: self._search_of_maps(request), response)

    def _on_register_point_sets(
        self, request: RegisterPointSets.Request, response: RegisterPointSets.Response
    ) -> RegisterPointSets.Response:
        return self._answer(lambda: self._search_of_points(request), response)

    def _answer(self, make_search: Any, response: Any) -> Any:
        job = self._begin(make_search, response)
        if job is not None:
            job.wait()
            self._finish(job, response)
        return response

    def _begin(self, make_search: Any, response: Any) -> Job | None:
        """Begin what a request asks for; None where it is refused, as the response then says."""
        if not self.is_active:
            response.result, response.message = response.BUSY, "the server is not active"
            self._statistics.count("busy")
            return None
        try:
            search: Search = make_search()
        except InvalidInputError as error:
            response.result, response.message = response.INVALID_INPUT, str(error)
            self._statistics.count("invalid_input")
            return None
        except Exception as error:  # noqa: BLE001 (a server survives whatever it is sent)
            response.result, response.message = response.FAILED, f"{type(error).__name__}: {error}"
            self.get_logger().error(response.message)
            self._statistics.count("failed")
            return None
        job = self._jobs.submit(search)
        if job is None:
            response.result = response.BUSY
            response.message = (
                f"{self._jobs.max_accepted} registrations are running or waiting, which is the "
                "limit (max_parallel + max_waiting); ask again later"
            )
            self._statistics.count("busy")
        return job

    def _finish(self, job: Job, response: Any) -> None:
        """Put the outcome of a finished job into a response."""
        try:
            result = job.future.result()
        except InvalidInputError as error:
            response.result, response.message = response.INVALID_INPUT, str(error)
            self._statistics.count("invalid_input")
        except Exception as error:  # noqa: BLE001 (a server survives whatever it is sent)
            response.result, response.message = response.FAILED, f"{type(error).__name__}: {error}"
            self.get_logger().error(f"registration failed: {response.message}")
            self._statistics.count("failed")
        else:
            response.result = response.DONE
            response.registration = registration_to_msg(result)
            self._statistics.count(result.verdict.name.lower())
            self._statistics.add_latency(time.monotonic() - job.begun_s)

    # --- what is asked -----------------------------------------------------------------------

    def _search_of_maps(self, request: Any) -> Search:
        source = self._map_of(request.source, "source")
        target = self._map_of(request.target, "target")
        prior, max_seconds = options_from_msg(request.options)
        config = adapted(self.settings(GridRegistrationConfig), max_seconds)
        return functools.partial(
            register_grids, source, target, config, prior=prior, clock=time.monotonic
        )

    def _map_of(self, msg: OccupancyGrid, name: str) -> OccupancyMap:
        num_cells = int(msg.info.width) * int(msg.info.height)
        if num_cells > self._config.max_cells:
            raise InvalidInputError(
                f"{name} has {msg.info.height} x {msg.info.width} = {num_cells} cells, expected "
                f"at most {self._config.max_cells} (parameter max_cells)"
            )
        return occupancy_from_msg(msg, name)

    def _search_of_points(self, request: RegisterPointSets.Request) -> Search:
        prior, max_seconds = options_from_msg(request.options)
        source = self._points_of(request.source, "source")
        target = self._points_of(request.target, "target")
        given: dict[str, float] = {}
        if not (math.isfinite(request.sigma_m) and request.sigma_m >= 0.0):
            raise InvalidInputError(
                f"sigma_m is {request.sigma_m}, expected a positive number, or 0 to derive it"
            )
        if request.sigma_m > 0.0:
            given["sigma"] = float(request.sigma_m)
        config = adapted(self.settings(RegistrationConfig), max_seconds, **given)
        return functools.partial(
            register_point_sets, source, target, config, prior=prior, clock=time.monotonic
        )

    def _points_of(self, msgs: Sequence[Any], name: str) -> NDArray[np.float64]:
        if len(msgs) > self._config.max_points:
            raise InvalidInputError(
                f"{name} has {len(msgs)} points, expected at most {self._config.max_points} "
                "(parameter max_points)"
            )
        points = np.array([(p.x, p.y) for p in msgs], dtype=np.float64).reshape(-1, 2)
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise InvalidInputError(
                f"{name}[{bad[0]}] is {points[bad[0]].tolist()}, expected finite metres"
            )
        return points

    # --- action ------------------------------------------------------------------------------

    def _execute(self, goal: ServerGoalHandle) -> RegisterMapsAction.Result:
        result = RegisterMapsAction.Result()
        job = self._begin(lambda: self._search_of_maps(goal.request), result)
        if job is None:
            goal.abort()
            return result
        is_cancelled = self._follow(goal, job)
        if is_cancelled and not job.wait(_CANCEL_PATIENCE_S):
            # Answered now; the search stops at its next look, and keeps its place until then.
            result.result = result.DONE
            refused = RegistrationResult.refused(
                Verdict.BUDGET_EXHAUSTED,
                "cancelled before the proof was complete"
                + ("; this is the best found so far" if job.newest else ""),
                best_so_far=job.newest,
                seconds=time.monotonic() - job.begun_s,
            )
            result.registration = registration_to_msg(refused)
            self._statistics.count("cancelled")
        else:
            self._finish(job, result)
        if is_cancelled:
            goal.canceled()
        elif result.result == result.DONE:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _follow(self, goal: ServerGoalHandle, job: Job) -> bool:
        """Send feedback until the job ends; True when the client cancelled it."""
        sent_s = 0.0
        while not job.wait(_POLL_S):
            if goal.is_cancel_requested:
                job.cancel()
                return True
            now_s = time.monotonic()
            if now_s - sent_s >= _FEEDBACK_PERIOD_S:
                sent_s = now_s
                goal.publish_feedback(_feedback(job.newest, now_s - job.begun_s))
        return bool(goal.is_cancel_requested)

    def _report(self) -> Report:
        counts = self._jobs.counts
        values = {
            "num_running": counts.num_running,
            "num_waiting": counts.num_waiting,
            "max_parallel": self._jobs.max_parallel,
            **self._statistics.values(),
        }
        is_full = counts.num_running + counts.num_waiting >= self._jobs.max_accepted
        text = f"{counts.num_running} running, {counts.num_waiting} waiting"
        return "warning" if is_full else "info", text, values


def adapted[ConfigT: Config](config: ConfigT, max_seconds: float, **given: float) -> ConfigT:
    """Settings with what the caller asks; a time limit of 0 keeps the server's.

    Raises
    ------
    InvalidInputError
        If what is asked is outside the setting's range.
    """
    if max_seconds != 0.0:
        given["max_seconds"] = max_seconds
    try:
        return type(config).from_dict({**config.to_dict(), **given})
    except ConfigError as error:
        raise InvalidInputError(f"the request asks for what cannot be: {error}") from error


def _feedback(progress: Progress | None, seconds: float) -> RegisterMapsAction.Feedback:
    if progress is None:  # before the search, nothing is proven and no pose is known
        return RegisterMapsAction.Feedback(
            stage="features",
            upper_bound=1.0,
            gap=1.0,
            seconds=float(seconds),
            t_target_source=transform2d_to_msg(None),
        )
    return RegisterMapsAction.Feedback(
        stage=progress.stage,
        lower_bound=float(progress.lower_bound),
        upper_bound=float(progress.upper_bound),
        gap=float(progress.gap),
        num_boxes=int(progress.num_boxes),
        num_open_boxes=int(progress.num_open_boxes),
        seconds=float(seconds),
        t_target_source=transform2d_to_msg(progress.T_target_source),
    )


class _Statistics:
    """Outcomes and latencies since the start."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._outcomes: Counter[str] = Counter()
        self._latencies_s: deque[float] = deque(maxlen=_NUM_LATENCIES)

    def count(self, outcome: str) -> None:
        """One more request that ended like this."""
        with self._lock:
            self._outcomes[outcome] += 1

    def add_latency(self, seconds: float) -> None:
        """Note how long a request took."""
        with self._lock:
            self._latencies_s.append(seconds)

    def values(self) -> dict[str, float | int | str]:
        """For the diagnostics, by name."""
        with self._lock:
            values: dict[str, float | int | str] = {
                f"num_{outcome}": count for outcome, count in sorted(self._outcomes.items())
            }
            latencies_s = list(self._latencies_s)
        if latencies_s:
            values["latency_median_s"] = float(np.median(latencies_s))
            values["latency_p95_s"] = float(np.percentile(latencies_s, 95))
            values["latency_newest_s"] = latencies_s[-1]
        return values


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until stopped."""
    # Searches side by side hand Python's lock to each other between short kernels; with the usual
    # 5 ms each waits for the other longer than its kernels take.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    return run_node("registration_server", RegistrationServer, argv)
