"""The services of a sonar mapper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger
from uw_dslam_msgs.srv import GetSubmap

from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.plumbing.qos import SERVICES
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["MapperServices"]

_TIMEOUT_S = 600.0


class _Owner(Protocol):
    """What the services need of the mapper; called in the worker's thread, but `pause`."""

    def finish(self) -> str: ...

    def reset(self) -> str: ...

    def pause(self, is_paused: bool) -> str: ...

    def issued(self, vehicle_id: str, run_id: int, sequence: int) -> Submap | None: ...


class MapperServices:
    """``~/finish``, ``~/reset``, ``~/pause`` and ``~/get_submap``."""

    def __init__(self, node: Node, owner: _Owner, worker: Worker) -> None:
        self._node, self._owner, self._worker = node, owner, worker
        group = ReentrantCallbackGroup()
        for service_type, name, serve in (
            (Trigger, "~/finish", self._finish),
            (Trigger, "~/reset", self._reset),
            (SetBool, "~/pause", self._pause),
            (GetSubmap, "~/get_submap", self._get_submap),
        ):
            node.create_service(
                service_type, name, serve, qos_profile=SERVICES, callback_group=group
            )

    def _finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._served("finish", self._owner.finish, response)

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._served("reset", self._owner.reset, response)

    def _served(self, name: str, job: Callable[[], str], response: Any) -> Any:
        """Answer a request with what a job in the worker's thread says."""
        try:
            response.message = self._worker.call(job).result(_TIMEOUT_S)
            response.success = True
        except Exception as error:  # noqa: BLE001 (the caller gets it)
            response.success = False
            response.message = f"{type(error).__name__}: {error}"
        self._node.get_logger().info(f"{name}: {response.message}")
        return response

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = True
        response.message = self._owner.pause(bool(request.data))
        self._node.get_logger().info(response.message)
        return response

    def _get_submap(
        self, request: GetSubmap.Request, response: GetSubmap.Response
    ) -> GetSubmap.Response:
        """Give a submap again, to whoever did not get it."""
        key = request.vehicle_id, int(request.run_id), int(request.sequence)
        response.result = response.NOT_FOUND
        try:
            found = self._worker.call(lambda: self._owner.issued(*key)).result(_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001 (the caller gets it)
            response.message = f"{type(error).__name__}: {error}"
            return response
        if found is None:
            response.message = f"this run of {key[0]} has no submap {key[2]}"
        else:
            response.result, response.submap = response.DONE, submap_to_msg(found)
        return response
