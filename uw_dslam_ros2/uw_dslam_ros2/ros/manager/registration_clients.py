"""The registration servers of the graph, and what was asked of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from uw_dslam_msgs.srv import RegisterMaps

from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, SERVICES

__all__ = ["RegistrationClients"]

_SERVICE_TYPE = "uw_dslam_msgs/srv/RegisterMaps"
_SERVICE_NAME = "register_maps"
_BUSY_PAUSE_S, _MAX_BUSY_PAUSE_S = 1.0, 8.0
"""Maps are large, and one that is not active is busy for long."""


@dataclass(slots=True, eq=False)
class _Asked:
    future: Future
    deadline_s: float


@dataclass(slots=True, eq=False)
class _Server:
    name: str
    client: Client
    asked: dict[int, _Asked] = field(default_factory=dict)
    busy_until_s: float = 0.0
    busy_pause_s: float = _BUSY_PAUSE_S  # until it is asked again
    num_silent: int = 0  # requests in a row that it did not answer in time
    instance: str = ""


class RegistrationClients:
    """Asks whichever server has a place; all methods belong to one thread.

    Parameters
    ----------
    node : whose clients they are.
    names : nodes to ask; empty means every one that the graph shows.
    max_per_server : requests asked of one server at a time.
    timeout_s : an answer that takes longer counts as lost.
    post : hands a function to the thread that owns this object.
    """

    def __init__(
        self,
        node: Node,
        names: Sequence[str],
        max_per_server: int,
        timeout_s: float,
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        self._node = node
        self._names = names
        self._max_per_server = max_per_server
        self._timeout_s = timeout_s
        self._post = post
        self._group = ReentrantCallbackGroup()
        self._servers: dict[str, _Server] = {}
        for name in names:
            self._add(f"/{name.strip('/')}/{_SERVICE_NAME}")
        node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda msg: post(lambda: self._note_instances(msg)),
            DEFAULT,
            callback_group=self._group,
        )

    def _add(self, service_name: str) -> None:
        client = self._node.create_client(
            RegisterMaps, service_name, qos_profile=SERVICES, callback_group=self._group
        )
        self._servers[service_name] = _Server(service_name, client)

    def set_limits(self, max_per_server: int, timeout_s: float) -> None:
        """Of the requests that are asked from now on."""
        self._max_per_server, self._timeout_s = max_per_server, timeout_s

    def discover(self) -> None:
        """Look for new servers."""
        if self._names:
            return
        for name, types in self._node.get_service_names_and_types():
            if _SERVICE_TYPE in types and name not in self._servers:
                self._add(name)
                self._node.get_logger().info(f"registration server found: {name}")

    def _ready(self) -> list[_Server]:
        return [server for server in self._servers.values() if server.client.service_is_ready()]

    @property
    def num_ready(self) -> int:
        """Servers on the graph now."""
        return len(self._ready())

    def num_free(self) -> int:
        """How many requests can be asked now."""
        now_s = time.monotonic()
        return sum(
            max(0, self._max_per_server - len(server.asked))
            for server in self._ready()
            if server.busy_until_s <= now_s
        )

    def ask(
        self,
        request_id: int,
        request: RegisterMaps.Request,
        on_answer: Callable[[int, RegisterMaps.Response], None],
    ) -> bool:
        """Ask the server with most free places; `on_answer` is called in the owning thread.

        False when there is none; a server that says BUSY is left alone for a while, and its
        answer comes through all the same.
        """
        now_s = time.monotonic()
        free = [
            server
            for server in self._ready()
            if server.busy_until_s <= now_s and len(server.asked) < self._max_per_server
        ]
        if not free:
            return False
        server = min(free, key=lambda server: (server.num_silent, len(server.asked)))
        future = server.client.call_async(request)
        server.asked[request_id] = _Asked(future, now_s + self._timeout_s)
        future.add_done_callback(
            lambda done: self._post(lambda: self._answered(server, request_id, done, on_answer))
        )
        return True

    def _answered(
        self,
        server: _Server,
        request_id: int,
        future: Future,
        on_answer: Callable[[int, RegisterMaps.Response], None],
    ) -> None:
        asked = server.asked.get(request_id)
        if asked is None or asked.future is not future or future.cancelled():
            return  # given up before
        del server.asked[request_id]
        server.num_silent = 0
        response: Any = future.result()
        if response.result == RegisterMaps.Response.BUSY:
            server.busy_until_s = time.monotonic() + server.busy_pause_s
            server.busy_pause_s = min(2.0 * server.busy_pause_s, _MAX_BUSY_PAUSE_S)
        else:
            server.busy_pause_s = _BUSY_PAUSE_S
        on_answer(request_id, response)

    def take_lost(self) -> list[tuple[int, str]]:
        """Requests that will not be answered any more, with the reason; they are forgotten."""
        now_s = time.monotonic()
        lost: list[tuple[int, str]] = []
        for server in self._servers.values():
            if not server.asked:
                continue
            is_gone = not server.client.service_is_ready()
            for request_id, asked in list(server.asked.items()):
                if is_gone:
                    lost.append((request_id, f"{server.name} is gone"))
                elif now_s > asked.deadline_s:
                    server.num_silent += 1
                    lost.append(
                        (request_id, f"{server.name} gave no answer in {self._timeout_s:.0f} s")
                    )
                else:
                    continue
                self._forget(server, request_id)
        return lost

    def forget_all(self) -> None:
        """Give up all that was asked."""
        for server in self._servers.values():
            for request_id in list(server.asked):
                self._forget(server, request_id)

    def _forget(self, server: _Server, request_id: int) -> None:
        server.client.remove_pending_request(server.asked.pop(request_id).future)

    # A server that died and came back answers to the same name, but knows nothing of the old
    # requests. Its diagnostics carry an id that is new with every start.

    def _note_instances(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            service_name = f"/{status.name.split(':')[0]}/{_SERVICE_NAME}"
            server = self._servers.get(service_name)
            if server is None or server.instance == status.hardware_id:
                continue
            if server.instance:
                self._orphan(server)
            server.instance = status.hardware_id

    def _orphan(self, server: _Server) -> None:
        for asked in server.asked.values():
            asked.deadline_s = float("-inf")
