"""What somebody does who replays a mission: watch the queue, finish the mappers, save."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from std_srvs.srv import Trigger
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.srv import SaveMap, SaveSession

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, LATCHED

__all__ = ["MissionControl"]

_MANAGER = "/map_queue_manager"
_QUIET_S = 2.5
_SPIN_S = 0.1


class MissionControl:
    """A client of the mapping nodes, in a context and domain of its own.

    Parameters
    ----------
    domain_id : DDS domain of the nodes.
    check : called again and again while waiting; raises to end the wait.
    """

    def __init__(self, domain_id: int, check: Callable[[], None]) -> None:
        self._check = check
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        # Without a log topic: there may be one of these for each of several domains.
        self._node = rclpy.create_node(
            "mission_control", context=self._context, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.status: MergeStatus | None = None
        self._node.create_subscription(MergeStatus, "/merge_status", self._on_status, LATCHED)
        self._diagnostics: dict[str, dict[str, str]] = {}
        self._num_told: Counter[str] = Counter()
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, DEFAULT
        )
        self._changed_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown(timeout_sec=5.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _on_status(self, msg: MergeStatus) -> None:
        last = self.status
        if last is None or msg.num_in_flight or _progress_of(msg) != _progress_of(last):
            self._changed_s = time.monotonic()
        self.status = msg

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            node = f"/{status.name.split(': ')[0]}"
            self._diagnostics[node] = {value.key: value.value for value in status.values}
            self._num_told[node] += 1

    def diagnostics_of(self, node: str) -> dict[str, str]:
        """What a node of that name, in any namespace, told last; empty where it told nothing."""
        told = (values for name, values in self._diagnostics.items() if name.endswith(f"/{node}"))
        return dict(next(told, {}))

    def spin(self) -> None:
        """Take what has come in, for a tenth of a second at most."""
        self._executor.spin_once(timeout_sec=_SPIN_S)

    def wait_until(self, is_true: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Spin until something is true.

        Raises
        ------
        DataError
            After the time limit, naming what did not happen.
        """
        end_s = time.monotonic() + timeout_s
        while not is_true():
            if time.monotonic() > end_s:
                raise DataError(f"{what}: not within {timeout_s:.0f} s")
            self._check()
            self.spin()

    def wait_for_nodes(self, vehicles: Sequence[str], timeout_s: float) -> None:
        """Wait for every mapper, the manager, and a registration server that the manager sees."""
        clients = [
            self._node.create_client(Trigger, f"/{vehicle}/sonar_mapper/finish")
            for vehicle in vehicles
        ]
        try:
            for client, vehicle in zip(clients, vehicles, strict=True):
                self.wait_until(client.service_is_ready, f"the mapper of {vehicle}", timeout_s)
        finally:
            for client in clients:
                self._node.destroy_client(client)
        self.wait_until(
            lambda: self.status is not None and self.status.num_servers > 0,
            "a map queue manager with a registration server",
            timeout_s,
        )

    def finish_mappers(
        self, vehicles: Sequence[str], timeout_s: float
    ) -> dict[str, dict[str, str]]:
        """Close every vehicle's last submap; returns what each mapper's diagnostics say then."""
        nodes = {vehicle: f"/{vehicle}/sonar_mapper" for vehicle in vehicles}
        futures = {
            vehicle: self._call(Trigger, f"{node}/finish", Trigger.Request())
            for vehicle, node in nodes.items()
        }
        for vehicle, future in futures.items():
            self.wait_until(future.done, f"the end of {vehicle}'s mapping", timeout_s)
            response: Any = future.result()
            if not response.success:
                raise DataError(f"{vehicle} could not finish its map: {response.message}")
        # One may have been on its way already.
        enough = {node: self._num_told[node] + 2 for node in nodes.values()}
        self.wait_until(
            lambda: all(self._num_told[node] >= num for node, num in enough.items()),
            "the diagnostics of every mapper",
            timeout_s,
        )
        return {vehicle: dict(self._diagnostics[node]) for vehicle, node in nodes.items()}

    def notes_on(self, told: Mapping[str, Mapping[str, str]]) -> list[str]:
        """What a report has to tell of the mapping; `told` is what `finish_mappers` returned."""
        notes = []
        for vehicle, values in told.items():
            submaps = [] if self.status is None else self.status.submaps
            num_runs = len({s.run_id for s in submaps if s.vehicle_id == vehicle})
            if num_runs > 1:
                notes.append(
                    f"{vehicle} began anew on its way: its map is {num_runs} runs, which only "
                    "registration joins. The log of its mapper says why."
                )
            num_bad = int(values["num_bad"])
            if num_bad:
                notes.append(
                    f"{vehicle} left {num_bad} bad messages out. The log of its mapper says which."
                )
        return notes

    def settle_queue(self, timeout_s: float = 60.0) -> None:
        """Tell the manager that no more submaps are expected."""
        future = self._call(Trigger, f"{_MANAGER}/settle", Trigger.Request())
        self.wait_until(future.done, "the queue's settling", timeout_s)
        self._changed_s = time.monotonic()

    def wait_until_settled(self, timeout_s: float, show: Callable[[MergeStatus], None]) -> bool:
        """Wait until the queue asks nothing and changes no more; False at the time limit."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            self._check()
            self.spin()
            status = self.status
            if status is None:
                continue
            show(status)
            is_quiet = time.monotonic() - self._changed_s > _QUIET_S
            if status.num_in_flight == 0 and is_quiet:
                return True
        return False

    def save_map(self, path: str, timeout_s: float = 60.0) -> str:
        """Have the manager save the global map; returns "" when done, else its reason."""
        request = SaveMap.Request(path=path)
        future = self._call(SaveMap, f"{_MANAGER}/save_map", request)
        self.wait_until(future.done, "saving the map", timeout_s)
        response: Any = future.result()
        return "" if response.result == response.DONE else str(response.message)

    def save_session(self, path: str, timeout_s: float = 120.0) -> None:
        """Have the manager save all that it knows.

        Raises
        ------
        DataError
            With the manager's reason.
        """
        request = SaveSession.Request(path=path)
        future = self._call(SaveSession, f"{_MANAGER}/save_session", request)
        self.wait_until(future.done, "saving the session", timeout_s)
        response: Any = future.result()
        if response.result != response.DONE:
            raise DataError(f"the manager could not save its session: {response.message}")

    def _call(self, service_type: Any, name: str, request: Any) -> Future:
        client = self._node.create_client(service_type, name)
        self.wait_until(client.service_is_ready, f"the service {name}", 30.0)
        return client.call_async(request)


def _progress_of(status: MergeStatus) -> tuple[Any, ...]:
    revisions = tuple(
        (s.vehicle_id, s.run_id, s.sequence, s.revision, s.state) for s in status.submaps
    )
    return status.num_registrations, status.num_components, revisions
