"""The view of a running graph: asks the manager, tells it what people decide, shows the page."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.srv import Decide, GetSubmap, ListDecisions, ListRegistrations

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import Decision
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg, transform2d_from_msg
from uw_dslam_ros2.ros.convert.decisions import decision_record_from_msg, decision_to_msg
from uw_dslam_ros2.ros.convert.merging import (
    answer_from_msg,
    constraint_from_msg,
    record_from_msg,
)
from uw_dslam_ros2.ros.manager.diagnostics_board import DiagnosticsBoard
from uw_dslam_ros2.ros.plumbing.node_settings import ViewConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, LATCHED, SERVICES
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.view.pace import Pace
from uw_dslam_ros2.view.server import ViewServer
from uw_dslam_ros2.view.showing import Showing

__all__ = ["View", "main"]

_LEAST_PERIOD_S = 0.2  # between two states that are shown
_SHARE = 0.1
"""Of a core, that following a manager may cost: a large merge is followed less often."""
_ANSWER_WITHIN_S = 20.0
_SILENT_S = 10.0
"""A manager that says nothing for this long is told; it speaks once a second."""


class View(Node):
    """Follows a manager's status and fetches what is new.

    Callbacks only note what came; one thread asks the manager, another serves pages.
    """

    num_threads = 4

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("view", **kwargs)
        self._config = declare_config(self, ViewConfig)
        refuse_unknown_parameters(self)
        manager = "/" + self._config.manager.strip("/")
        self.title = f"{manager} on this graph"
        group = ReentrantCallbackGroup()
        self._get_submap = self._client(GetSubmap, f"{manager}/get_submap", group)
        self._list_registrations = self._client(
            ListRegistrations, f"{manager}/list_registrations", group
        )
        self._decide = self._client(Decide, f"{manager}/decide", group)
        self._list_decisions = self._client(ListDecisions, f"{manager}/list_decisions", group)
        self._submaps: dict[SubmapId, Submap] = {}
        self._answers: list[tuple[Answer, bool]] = []
        self._num_answers = -1
        self._told: tuple[object, ...] = ()
        self._on_change: Callable[[], None] = lambda: None
        self._showing = Showing([], [])
        self._status: MergeStatus | None = None
        self._heard_s = float("-inf")
        self._changed_s: dict[Track, float] = {}
        self._board = DiagnosticsBoard()
        self._is_new, self._is_stopped = threading.Event(), threading.Event()
        self._server = ViewServer(
            self, self._config.address, self._config.port, self._config.token
        )
        self._loop = asyncio.new_event_loop()
        self._threads = [
            threading.Thread(target=self._serve, name="pages", daemon=True),
            threading.Thread(target=self._follow, name="follow", daemon=True),
        ]
        self._threads[0].start()
        self.url = asyncio.run_coroutine_threadsafe(self._server.start(), self._loop).result()
        self.get_logger().info(f"open {self.url} in a browser")
        self._threads[1].start()
        namespace = manager.rsplit("/", 1)[0]
        self.create_subscription(
            MergeStatus,
            f"{namespace}/merge_status",
            self._on_status,
            LATCHED,
            callback_group=group,
        )
        self.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, DEFAULT, callback_group=group
        )

    def showing(self) -> Showing:
        """The newest state."""
        return self._showing

    def status(self) -> dict[str, Any]:
        """Ages and what is wrong."""
        now_s = time.monotonic()
        notes = self._board.troubles()
        if now_s - self._heard_s > _SILENT_S:
            notes.insert(0, f"{self._config.manager} is not heard")
        status = self._status
        return {
            "is_live": True,
            "message": "" if status is None else status.message,
            "num_servers": 0 if status is None else int(status.num_servers),
            "num_in_flight": 0 if status is None else int(status.num_in_flight),
            "ages": {
                self._showing.names.track(track): now_s - since_s
                for track, since_s in list(self._changed_s.items())
            },
            "notes": notes,
            "diagnostics": self._board.rows(now_s),
        }

    def listen(self, on_change: Callable[[], None]) -> None:
        """Have something called when the state has changed."""
        self._on_change = on_change

    def decide(self, decision: Decision) -> Decision:
        """Have the manager write it down; what follows comes with its next status.

        Raises
        ------
        InvalidInputError
            With the manager's reason to refuse it.
        TimeoutError
            If the manager does not answer.
        """
        stamp_ns = int(self.get_clock().now().nanoseconds)
        msg = decision_to_msg(dataclasses.replace(decision, stamp_ns=stamp_ns, number=0))
        response = self._ask(self._decide, Decide.Request(decision=msg))
        if response.result != response.DONE:
            raise InvalidInputError(response.message)
        return dataclasses.replace(decision, stamp_ns=stamp_ns, number=int(response.number))

    def stop(self) -> None:
        """End both threads."""
        self._is_stopped.set()
        self._is_new.set()
        asyncio.run_coroutine_threadsafe(self._server.stop(), self._loop).result(1.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._threads[0].join(1.0)

    def _serve(self) -> None:
        """Answer browsers until told to stop."""
        try:
            self._loop.run_forever()
        finally:
            self._loop.close()

    def _client(self, service_type: Any, name: str, group: ReentrantCallbackGroup) -> Any:
        return self.create_client(service_type, name, qos_profile=SERVICES, callback_group=group)

    def _on_status(self, msg: MergeStatus) -> None:
        self._heard_s = time.monotonic()
        self._status = msg
        self._is_new.set()

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self._board.note(msg, time.monotonic())

    def _follow(self) -> None:
        pace = Pace(_SHARE)
        while not self._is_stopped.is_set():
            self._is_new.wait()
            self._is_new.clear()
            status = self._status
            if self._is_stopped.is_set() or status is None:
                continue
            pace.begin(time.monotonic())
            begun_s = time.thread_time()
            try:
                self._show(status)
            except (InvalidInputError, TimeoutError) as error:
                self.get_logger().warning(f"cannot show the newest state: {error}")
            pace.spend(time.thread_time() - begun_s)
            self._is_stopped.wait(max(_LEAST_PERIOD_S, pace.wait_s(time.monotonic())))

    def _show(self, status: MergeStatus) -> None:
        told = (status.submaps, status.constraints, status.num_registrations, status.message)
        if told == self._told:  # it speaks once a second even if nothing happens
            return
        records = []
        for info in status.submaps:
            submap_id = SubmapId(info.vehicle_id, int(info.run_id), int(info.sequence))
            held = self._submaps.get(submap_id)
            if held is None or held.revision != info.revision:
                held = self._fetch(submap_id)
                self._submaps[submap_id] = held
                self._changed_s[submap_id.track] = time.monotonic()
            records.append(record_from_msg(info, held))
        if status.num_registrations != self._num_answers:
            response = self._ask(self._list_registrations, ListRegistrations.Request())
            self._answers = [answer_from_msg(msg) for msg in response.registrations]
            self._num_answers = status.num_registrations
        constraints = [constraint_from_msg(msg) for msg in status.constraints]
        listed = self._ask(self._list_decisions, ListDecisions.Request())
        decisions = [decision_record_from_msg(msg) for msg in listed.decisions]
        georeference = None
        if listed.earth_frame:
            T_earth_map = transform2d_from_msg(listed.t_earth_map, "t_earth_map")
            georeference = listed.earth_frame, T_earth_map
        showing = Showing(
            records, constraints, self._answers, self._showing, decisions, georeference
        )
        if showing.version != self._showing.version:
            self._showing = showing
            self._on_change()
        self._told = told

    def _fetch(self, submap_id: SubmapId) -> Submap:
        request = GetSubmap.Request(
            vehicle_id=submap_id.vehicle_id,
            run_id=submap_id.run_id,
            sequence=submap_id.sequence,
        )
        response = self._ask(self._get_submap, request)
        if response.result != response.DONE:
            raise InvalidInputError(response.message)
        return submap_from_msg(response.submap)

    def _ask(self, client: Any, request: Any) -> Any:
        deadline_s = time.monotonic() + _ANSWER_WITHIN_S
        # What is asked before the service is found is lost.
        while not client.service_is_ready():
            self._go_on(client, deadline_s)
            self._is_stopped.wait(0.05)
        future, is_done = client.call_async(request), threading.Event()
        future.add_done_callback(lambda _: is_done.set())
        try:
            while not is_done.wait(0.2):
                self._go_on(client, deadline_s)
        except TimeoutError:
            client.remove_pending_request(future)
            raise
        return future.result()

    def _go_on(self, client: Any, deadline_s: float) -> None:
        if time.monotonic() > deadline_s or self._is_stopped.is_set():
            raise TimeoutError(f"{client.srv_name} does not answer")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("view", View, argv)


if __name__ == "__main__":
    raise SystemExit(main())
