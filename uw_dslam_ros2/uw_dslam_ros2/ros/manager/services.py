"""The services of the map queue manager."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger
from uw_dslam_msgs.srv import (
    Decide,
    GetSubmap,
    ListDecisions,
    ListRegistrations,
    ListSubmaps,
    LoadSession,
    RestoreSubmap,
    SaveMap,
    SaveSession,
    WithdrawSubmap,
)

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import Decision, DecisionKind, MapQueue
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.maps.provenance import write_provenance
from uw_dslam_ros2.io.sessions.session import SESSION_FILE, has_session
from uw_dslam_ros2.io.sessions.session_export import export_queue
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg, transform2d_to_msg
from uw_dslam_ros2.ros.convert.decisions import decision_from_msg, decision_to_msg
from uw_dslam_ros2.ros.convert.merging import answer_to_msg, record_to_msg
from uw_dslam_ros2.ros.plumbing.qos import SERVICES
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["QueueOwner", "QueueServices"]

_TIMEOUT_S = 600.0


class QueueOwner(Protocol):
    """What the services need of the manager; called in the worker's thread, but `complain`."""

    @property
    def queue(self) -> MapQueue:
        """The queue as it is now."""
        ...

    def changed(self, message: str) -> None:
        """The queue was changed."""
        ...

    def resume(self, path: str) -> MapQueue:
        """Go on with the session in a folder, in the place of the queue."""
        ...

    def save_session(self, path: str) -> Path:
        """Save the queue in a folder; the session's file."""
        ...

    def settle(self) -> None:
        """No more submaps are expected."""
        ...

    def complain(self, text: str) -> None:
        """Something was wrong that came from outside."""
        ...


class QueueServices:
    """Serves in the worker's thread, so that no request meets a queue in mid-change."""

    def __init__(
        self, node: Node, owner: QueueOwner, worker: Worker, group: ReentrantCallbackGroup
    ) -> None:
        self._node, self._owner, self._worker = node, owner, worker
        for service_type, name, handler in (
            (SaveMap, "save_map", self._save_map),
            (ListSubmaps, "list_submaps", self._list_submaps),
            (GetSubmap, "get_submap", self._get_submap),
            (ListRegistrations, "list_registrations", self._list_registrations),
            (Decide, "decide", self._decide),
            (ListDecisions, "list_decisions", self._list_decisions),
            (WithdrawSubmap, "withdraw_submap", self._withdraw_submap),
            (RestoreSubmap, "restore_submap", self._restore_submap),
            (SaveSession, "save_session", self._save_session),
            (LoadSession, "load_session", self._load_session),
            (Trigger, "settle", self._settle),
        ):
            serve = functools.partial(self._serve, handler)
            node.create_service(
                service_type, f"~/{name}", serve, qos_profile=SERVICES, callback_group=group
            )

    def _serve(self, handler: Callable[[Any, Any], None], request: Any, response: Any) -> Any:
        try:
            job = self._worker.call(lambda: handler(request, response))
            job.result(_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001 (a bad request must not end the node)
            self._owner.complain(f"{type(request).__name__}: {error}")
            if hasattr(response, "FAILED"):
                response.result = response.FAILED
            if hasattr(response, "message"):
                response.message = f"{type(error).__name__}: {error}"
        return response

    def _save_map(self, request: SaveMap.Request, response: SaveMap.Response) -> None:
        occupancy = self._owner.queue.global_map()
        if occupancy is None:
            response.result = response.NOTHING_TO_SAVE
            response.message = "no submap received yet"
            return
        if not request.path:
            raise InvalidInputError("path is empty, expected a file name without an ending")
        paths = write_map(request.path, occupancy)
        provenance = self._owner.queue.provenance()
        if provenance is not None:
            paths += write_provenance(request.path, provenance)
        response.files = [str(path) for path in paths]
        response.result = response.DONE
        response.message = f"{len(response.files)} files written"

    def _list_submaps(self, request: ListSubmaps.Request, response: ListSubmaps.Response) -> None:
        response.submaps = [
            record_to_msg(record)
            for record in self._owner.queue.submaps()
            if request.vehicle_id in ("", record.submap.vehicle_id)
        ]

    def _get_submap(self, request: GetSubmap.Request, response: GetSubmap.Response) -> None:
        submap_id = self._submap_id(request)
        for record in self._owner.queue.submaps():
            if record.submap.submap_id == submap_id:
                response.result = response.DONE
                response.submap = submap_to_msg(record.submap)
                response.info = record_to_msg(record)
                return
        response.result = response.NOT_FOUND
        response.message = _not_found(submap_id)

    def _list_registrations(
        self, request: ListRegistrations.Request, response: ListRegistrations.Response
    ) -> None:
        response.registrations = [
            answer_to_msg(answer, is_used)
            for answer, is_used in self._owner.queue.answers()
            if request.vehicle_id == ""
            or any(
                i.vehicle_id == request.vehicle_id
                for i in (*answer.query.source.ids, *answer.query.target.ids)
            )
        ]

    def _decide(self, request: Decide.Request, response: Decide.Response) -> None:
        queue = self._owner.queue
        asked = decision_from_msg(request.decision, queue.newest_run, queue.stated_pose)
        ends = [end for end in (asked.source, asked.target) if end is not None]
        if lacking := next((end for end in ends if queue.submap(end) is None), None):
            response.result, response.message = response.NOT_FOUND, _not_found(lacking)
            return
        if asked.undone > queue.num_decisions:
            response.result = response.NOT_FOUND
            response.message = f"no decision {asked.undone}; ~/list_decisions lists them"
            return
        # By the caller's clock, else by this node's.
        stamp_ns = asked.stamp_ns or int(self._node.get_clock().now().nanoseconds)
        taken = queue.decide(dataclasses.replace(asked, stamp_ns=stamp_ns, number=0))
        response.result, response.number = response.DONE, taken.number
        response.message = _sentence(taken)
        self._owner.changed(response.message)

    def _list_decisions(self, _: Any, response: ListDecisions.Response) -> None:
        queue = self._owner.queue
        response.decisions = [
            decision_to_msg(record.decision, record.is_in_force, record.remark)
            for record in queue.decisions()
        ]
        found = queue.georeference()
        response.t_earth_map = transform2d_to_msg(None if found is None else found.T_earth_map)
        if found is not None:
            response.earth_frame = found.earth_frame

    def _submap_id(self, request: Any) -> SubmapId:
        """Which submap is meant; without a run that of the vehicle's newest one."""
        run_id = int(request.run_id) or self._owner.queue.newest_run(request.vehicle_id)
        return SubmapId(request.vehicle_id, run_id, int(request.sequence))

    def _withdraw_submap(self, request: Any, response: Any) -> None:
        self._switch(request, response, DecisionKind.WITHDRAW, "withdrawn")

    def _restore_submap(self, request: Any, response: Any) -> None:
        self._switch(request, response, DecisionKind.RESTORE, "back in the queue")

    def _switch(self, request: Any, response: Any, kind: DecisionKind, word: str) -> None:
        submap_id, queue = self._submap_id(request), self._owner.queue
        act = queue.withdraw if kind is DecisionKind.WITHDRAW else queue.restore
        if not act(submap_id, stamp_ns=int(self._node.get_clock().now().nanoseconds)):
            response.result, response.message = response.NOT_FOUND, _not_found(submap_id)
            return
        response.result = response.DONE
        response.message = f"{submap_id} {word}"
        self._owner.changed(response.message)

    def _save_session(self, request: SaveSession.Request, response: SaveSession.Response) -> None:
        if not request.path:
            raise InvalidInputError("path is empty, expected a folder")
        queue = self._owner.queue
        paths = [self._owner.save_session(request.path), *export_queue(request.path, queue)]
        response.files = [str(path) for path in paths]
        response.result = response.DONE
        response.message = f"{len(response.files)} files written"

    def _load_session(self, request: LoadSession.Request, response: LoadSession.Response) -> None:
        if not has_session(request.path):
            response.result = response.NOT_FOUND
            response.message = f"there is no {SESSION_FILE} in {request.path!r}"
            return
        queue = self._owner.resume(request.path)
        response.result = response.DONE
        response.num_submaps = len(queue.submaps())
        response.message = f"{response.num_submaps} submaps loaded"
        self._owner.changed(response.message)

    def _settle(self, _: Trigger.Request, response: Trigger.Response) -> None:
        self._owner.settle()
        response.success = True
        response.message = "what is left to match is asked now"


def _sentence(decision: Decision) -> str:
    """What was decided, in a line."""
    who = decision.who or "somebody"
    if decision.kind is DecisionKind.UNDO:
        return f"decision {decision.number}: {who} undid decision {decision.undone}"
    kind = decision.kind.name
    ends = [str(end) for end in (decision.source, decision.target) if end is not None]
    whole = " (whole runs)" if decision.is_run else ""
    return f"decision {decision.number}: {who} said {kind} of {' and '.join(ends)}{whole}"


def _not_found(submap_id: SubmapId) -> str:
    return f"no submap {submap_id}; ~/list_submaps lists them"
