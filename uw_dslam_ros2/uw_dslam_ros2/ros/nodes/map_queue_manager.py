"""Collects the submaps of all vehicles, has them registered, and publishes one global map."""

from __future__ import annotations

import functools
import math
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import RegisterMaps
from visualization_msgs.msg import MarkerArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import (
    Constraint,
    ConstraintKind,
    GrowingMapConfig,
    MapChange,
    MapQueue,
    MapQueueConfig,
    MatchRequest,
    StartPoses,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.session import load_session
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_to_msg,
    submap_frame_id,
    submap_from_msg,
    submap_id_of,
)
from uw_dslam_ros2.ros.convert.merging import (
    constraint_to_msg,
    graph_to_markers,
    group_frame_id,
    groups_to_msgs,
    record_to_msg,
)
from uw_dslam_ros2.ros.convert.registration import options_to_msg, registration_from_msg
from uw_dslam_ros2.ros.plumbing.diagnostics import Diagnostics, Report
from uw_dslam_ros2.ros.plumbing.frames import WARNING_PERIOD_S, FrameBroadcaster, transform_to_msg
from uw_dslam_ros2.ros.plumbing.idle_timeout import IdleTimeout
from uw_dslam_ros2.ros.plumbing.map_inputs import MapInputs
from uw_dslam_ros2.ros.plumbing.map_publisher import MapPublisher
from uw_dslam_ros2.ros.plumbing.missing_submaps import MissingSubmaps
from uw_dslam_ros2.ros.plumbing.node_settings import MapQueueManagerConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SUBMAPS
from uw_dslam_ros2.ros.plumbing.queue_services import QueueServices
from uw_dslam_ros2.ros.plumbing.registration_clients import RegistrationClients
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.ros.plumbing.session_keeper import SessionKeeper
from uw_dslam_ros2.ros.plumbing.throttle import Throttle
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["MapQueueManager", "MapQueueManagerConfig", "main"]

_SUBMAP_TYPE = "uw_dslam_msgs/msg/Submap"
_TICK_S = 0.1
_STATUS_PERIOD_S = 1.0
_DISCOVERY_PERIOD_S = 0.5
_SEARCH_SHARE = 0.8
"""Of the time after which a request counts as lost, what a search may take."""


class MapQueueManager(Node):
    """Drives a `MapQueue` in a thread of its own; callbacks only hand it work."""

    num_threads = 8

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("map_queue_manager", **kwargs)
        self._config = declare_config(self, MapQueueManagerConfig)
        self._queue_config = declare_config(self, MapQueueConfig, "queue")
        growing_config = declare_config(self, GrowingMapConfig, "maps")
        refuse_unknown_parameters(self)
        self._start_poses = StartPoses.of_texts(
            self._config.start_poses, self._config.start_error_m, self._config.start_error_rad
        )
        self._queue = MapQueue(self._queue_config)
        self._message = "waiting for submaps"
        self._idle = IdleTimeout(self._config.quiet_s)
        self._counts: Counter[str] = Counter()
        self._values: dict[str, float | int | str] = {}
        self._asked: dict[int, MatchRequest] = {}
        self._is_changed = True
        # Drawing a large map takes a second: questions and answers come first.
        self._drawing = Throttle(self._config.publish_period_s)
        self._status_s = self._discovered_s = float("-inf")
        self._sent_transforms: tuple[Any, ...] = ()
        self._is_tick_posted = threading.Event()
        self._keeper = SessionKeeper(self._config.session, self.complain)
        self._resume()

        self._map = MapPublisher(self, self._config.map_frame, self._config.full_map_period_s)
        self._status_pub = self.create_publisher(MergeStatus, "merge_status", LATCHED)
        self._graph_pub = self.create_publisher(MarkerArray, "pose_graph", LATCHED)
        self._broadcaster = FrameBroadcaster(self) if self._config.publishes_tf else None
        self._group = ReentrantCallbackGroup()
        self._topics: set[str] = set()
        self._owners: dict[str, str] = {}
        self._worker = Worker("map queue", self._on_worker_error)
        self._servers = RegistrationClients(
            self,
            self._config.servers,
            self._config.requests_per_server,
            self._config.request_timeout_s,
            self._worker.post,
        )
        self._missing = MissingSubmaps(self, self._worker.post, self._on_submap)
        self._maps = MapInputs(
            self,
            self._config.map_topics,
            is_discovering=self._config.is_discovering_maps,
            config=growing_config,
            post=self._worker.post,
            on_change=self._on_map_change,
            on_growth=lambda: self._idle.note(time.monotonic()),
            complain=self.complain,
            submaps_of=self._submaps_of,
        )
        for vehicle_id in self._config.vehicles:
            self._subscribe(f"/{vehicle_id.strip('/')}/submap")
        QueueServices(self, self, self._worker, self._group)
        self._diagnostics = Diagnostics(self, self._report, self._config.map_frame)
        # Steady: registrations go on when a replay and its clock have ended.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=steady, callback_group=self._group)

    def stop(self) -> None:
        """End the worker after the job at hand; keep the session."""
        self._worker.close(timeout_s=10.0)
        self._keeper.close(self._queue)

    def destroy_node(self) -> None:
        """Stop, then destroy."""
        self.stop()
        super().destroy_node()

    # --- callbacks ---------------------------------------------------------------------------

    def _subscribe(self, topic: str) -> None:
        if topic in self._topics:
            return
        self._topics.add(topic)
        self.create_subscription(
            SubmapMsg,
            topic,
            functools.partial(self._on_submap, topic),
            SUBMAPS,
            callback_group=self._group,
        )
        self.get_logger().info(f"taking submaps from {topic}")

    def _on_submap(self, topic: str, msg: SubmapMsg) -> None:
        self._counts["num_submap_messages"] += 1
        if msg.is_pose_only:
            self._worker.post(lambda: self._move_submap(topic, msg))
            return
        try:
            submap = submap_from_msg(msg)
        except InvalidInputError as error:
            self.complain(f"bad submap on {topic}: {error}")
            return
        self._worker.post(lambda: self._add_submap(topic, submap))

    def complain(self, text: str) -> None:
        """Tell of something wrong that came from outside."""
        self._counts["num_bad"] += 1
        self._message = text
        self.get_logger().error(text, throttle_duration_sec=WARNING_PERIOD_S)

    def _on_worker_error(self, error: Exception) -> None:
        self.complain(f"{type(error).__name__}: {error}")

    def _on_tick(self) -> None:
        # While the worker is busy, ticks must not pile up.
        if not self._is_tick_posted.is_set():
            self._is_tick_posted.set()
            self._worker.post(self._tick)

    # --- in the worker's thread: submaps and registrations -----------------------------------

    def _move_submap(self, topic: str, msg: SubmapMsg) -> None:
        """Take a message that only moves a submap; who lacks the submap asks for it."""
        submap_id = submap_id_of(msg)
        held = self._queue.submap(submap_id)
        if held is None:
            self._queue.note_missing(submap_id)
            self._missing.note(topic, submap_id)
            return
        try:
            submap = submap_from_msg(msg, held)
        except InvalidInputError as error:
            self.complain(f"bad submap on {topic}: {error}")
            return
        self._add_submap(topic, submap)

    def _add_submap(self, topic: str, submap: Submap) -> None:
        # Nobody takes a name from its owner, unless that one is gone.
        owner = self._owners.setdefault(submap.vehicle_id, topic)
        if owner != topic and self.count_publishers(owner):
            self.complain(
                f"submap refused on {topic}: {submap.vehicle_id} is heard on {owner}; are there "
                "two vehicles of this name?"
            )
            return
        self._owners[submap.vehicle_id] = topic
        try:
            is_new = self._queue.add_submap(submap)
        except InvalidInputError as error:
            self.complain(f"submap refused on {topic}: {error}")
            return
        self._missing.note(topic, submap.submap_id)
        if not is_new:
            self._counts["num_repeated"] += 1
            return
        self._idle.note(time.monotonic())
        self.changed(f"{submap.submap_id} revision {submap.revision} received")

    def _on_map_change(self, topic: str, vehicle_id: str, change: MapChange) -> None:
        if change.has_jumped:
            self.get_logger().warning(
                f"the map of {vehicle_id} has jumped: it is matched anew",
                throttle_duration_sec=WARNING_PERIOD_S,
            )
            self._queue.forget_answers(vehicle_id)
        for submap in change.submaps:
            self._add_submap(topic, submap)

    def _submaps_of(self, vehicle_id: str) -> list[Submap]:
        submaps = (record.submap for record in self._queue.submaps())
        return [submap for submap in submaps if submap.vehicle_id == vehicle_id]

    def changed(self, message: str) -> None:
        """Note that the queue was changed."""
        self._message = message
        self._is_changed = True
        self._keeper.note_change()

    def _tick(self) -> None:
        self._is_tick_posted.clear()
        now_s = time.monotonic()
        if now_s - self._discovered_s >= _DISCOVERY_PERIOD_S:
            self._discovered_s = now_s
            self._discover()
            self._missing.look(self._queue.missing())
        for request_id, reason in self._servers.take_lost():
            self._ask_again(request_id, reason)
        if not self._idle.is_active(now_s):
            self._maps.rest()
        self._queue.is_growing = self._idle.is_active(now_s)
        for notice in self._queue.take_notices():
            self._message = notice
            self.get_logger().warning(notice)
        self._ask()
        # First saved, then told: what anybody has heard of outlives a kill.
        self._keeper.save_if_due(self._queue)
        if self._is_changed and self._drawing.is_due():
            self._is_changed = False
            with self._drawing.turn():
                self._publish_map()
                self._publish_status()
        elif now_s - self._status_s >= _STATUS_PERIOD_S:
            self._publish_status()
        self._map.publish_overdue(self._now())
        self._publish_transforms()

    def _discover(self) -> None:
        self._servers.discover()
        self._maps.look()
        if not self._config.vehicles:
            for topic, types in self.get_topic_names_and_types():
                if _SUBMAP_TYPE in types:
                    self._subscribe(topic)

    def _ask(self) -> None:
        num_free = self._servers.num_free()
        if num_free <= 0:
            return
        for request in self._queue.next_requests(num_free):
            # A server's own time limit would let a busy machine refuse what a quiet one accepts;
            # the number of boxes decides, and this is for what never ends.
            max_seconds = _SEARCH_SHARE * self._config.request_timeout_s
            prior = request.prior or self._start_prior(request)
            msg = RegisterMaps.Request(options=options_to_msg(prior, max_seconds))
            frames = (
                submap_frame_id(request.source_reference),
                submap_frame_id(request.target_reference),
            )
            msg.source = occupancy_to_msg(request.source, frames[0], 0)
            msg.target = occupancy_to_msg(request.target, frames[1], 0)
            if self._servers.ask(request.request_id, msg, self._on_answer):
                self._asked[request.request_id] = request
            else:
                self._queue.cancel_request(request.request_id)

    def _start_prior(self, request: MatchRequest) -> PriorWindow | None:
        """What the vehicles' start poses say of the maps in a request."""
        ends = request.source_reference, request.target_reference
        places = [(i.vehicle_id, self._queue.T_odom_submap(i)) for i in ends]
        return self._start_poses.window(*places[0], *places[1])

    def _on_answer(self, request_id: int, response: RegisterMaps.Response) -> None:
        request = self._asked.get(request_id)
        if request is None:
            return
        if response.result == RegisterMaps.Response.BUSY:
            self._ask_again(request_id, "the server is busy")
            return
        del self._asked[request_id]
        if response.result == RegisterMaps.Response.DONE:
            try:
                result = registration_from_msg(response.registration)
            except InvalidInputError as error:
                result = _unanswered(f"unusable answer: {error}")
        else:
            result = _unanswered(f"the server could not answer: {response.message}")
        self._counts[f"num_{result.verdict.name.lower()}"] += 1
        self._queue.add_result(request_id, result)
        pair = f"{_names(request.source_ids)} to {_names(request.target_ids)}"
        self.changed(f"{pair}: {result.verdict.name}: {result.reason}")
        self.get_logger().info(self._message)

    def _ask_again(self, request_id: int, reason: str) -> None:
        self._asked.pop(request_id, None)
        self._queue.cancel_request(request_id)
        self._counts["num_asked_again"] += 1
        self.get_logger().warning(
            f"registration {request_id} is asked again: {reason}",
            throttle_duration_sec=WARNING_PERIOD_S,
        )

    # --- in the worker's thread: what is published -------------------------------------------

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _publish_map(self) -> None:
        changed = self._queue.changed_window()
        if changed is None:
            return
        occupancy = self._queue.global_map()
        if occupancy is not None:
            self._map.publish(occupancy, changed[0], self._now())

    def _publish_status(self) -> None:
        self._status_s = time.monotonic()
        stamp = self.get_clock().now().to_msg()
        records, constraints = self._queue.submaps(), self._queue.constraints()
        states = Counter(record.state for record in records)
        msg = MergeStatus(
            submaps=[record_to_msg(record) for record in records],
            constraints=[constraint_to_msg(constraint) for constraint in constraints],
            num_waiting=states[SubmapState.WAITING],
            num_merged=states[SubmapState.MERGED],
            num_set_aside=states[SubmapState.SET_ASIDE],
            num_components=len({record.component for record in records}),
            groups=groups_to_msgs(records, self._config.map_frame),
            num_registrations=self._queue.num_registrations,
            num_in_flight=len(self._asked),
            num_servers=self._servers.num_ready,
            message=self._message,
        )
        msg.header.stamp = stamp
        msg.header.frame_id = self._config.map_frame
        self._status_pub.publish(msg)
        markers = graph_to_markers(records, constraints, self._config.map_frame, stamp)
        self._graph_pub.publish(markers)
        self._values = {
            name: getattr(msg, name)
            for name in ("num_waiting", "num_merged", "num_components", "num_registrations")
        }
        self._values |= {"num_in_flight": msg.num_in_flight, "num_servers": msg.num_servers}
        self._values["num_submaps"] = len(records)
        self._values["is_growing"] = int(self._queue.is_growing)
        self._values |= self._residuals(constraints)

    def _residuals(self, constraints: Sequence[Constraint]) -> dict[str, float | int | str]:
        """How well edges and cycles close, for the diagnostics."""
        edges = [c for c in constraints if c.kind is ConstraintKind.REGISTRATION]
        loops = self._queue.loops()
        return {
            "num_edges": sum(c.is_inlier for c in edges),
            "num_edges_unsure": sum(c.is_inlier and c.is_unsure for c in edges),
            "num_edges_rejected": sum(not c.is_inlier for c in edges),
            "num_loops": len(loops),
            "loop_error_max_m": max((loop.error_m for loop in loops), default=0.0),
            "loop_error_max_deg": math.degrees(
                max((loop.error_rad for loop in loops), default=0.0)
            ),
        }

    def _publish_transforms(self) -> None:
        """Each group's frame -> <vehicle>/map: when the clock moves, or a new reader comes.

        A vehicle that leaves the global map gets another parent, which ends its old transform.
        """
        if self._broadcaster is None:
            return
        stamp_ns = self._now()
        places = self._places()
        state = (stamp_ns, tuple(places), self._broadcaster.num_readers)
        if not places or stamp_ns == 0 or state == self._sent_transforms:
            return
        self._sent_transforms = state
        stamp = self.get_clock().now().to_msg()
        self._broadcaster.send(
            *(
                transform_to_msg(stamp, frame_id, self._maps.frame_of(name, frame_id), T)
                for frame_id, name, T in places
            )
        )

    def _places(self) -> list[tuple[str, str, SE2]]:
        """Of each vehicle's newest run: frame of its group, vehicle, place of its map there."""
        groups: dict[int, list[SubmapRecord]] = {}
        newest: dict[str, SubmapRecord] = {}
        for record in self._queue.submaps():
            submap = record.submap
            groups.setdefault(record.component, []).append(record)
            is_newest_run = submap.run_id == self._queue.newest_run(submap.vehicle_id)
            if is_newest_run and record.state is not SubmapState.SET_ASIDE:
                newest[submap.vehicle_id] = record
        map_frame = self._config.map_frame
        return [
            (
                group_frame_id(record.component, groups[record.component], map_frame),
                vehicle_id,
                record.T_component_submap @ record.submap.T_odom_submap.inverse(),
            )
            for vehicle_id, record in sorted(newest.items())
        ]

    # --- what the services ask for -----------------------------------------------------------

    @property
    def queue(self) -> MapQueue:
        """The queue as it is now."""
        return self._queue

    def resume(self, path: str) -> MapQueue:
        """Go on with the session in a folder, in the place of the queue."""
        queue = load_session(path, self._queue_config)
        self._servers.forget_all()
        self._asked.clear()
        self._queue = queue
        self._maps.forget()
        self._map.clear()
        return queue

    def settle(self) -> None:
        """No more submaps are expected: ask all that is left."""
        self._maps.rest()
        self._idle.end()
        self._tick()

    def save_session(self, path: str) -> Path:
        """Save the queue in a folder, be it the manager's own or another."""
        return self._keeper.save_in(path, self._queue)

    def _resume(self) -> None:
        """Go on where a session ended; a damaged one ends the start with a clear sentence."""
        queue = self._keeper.load(self._queue_config)
        if queue is not None:
            self._queue = queue
            self._message = f"session {self._config.session} resumed"
        elif self._config.session:
            self._message = f"a new session begins in {self._config.session}"
        self.get_logger().info(self._message)

    def _report(self) -> Report:
        values = {**self._values, **dict(sorted(self._counts.items()))}
        values["num_jobs_waiting"] = self._worker.num_waiting
        values |= self._missing.values()
        if trouble := self._keeper.trouble:
            return "error", trouble, values
        num_servers = self._values.get("num_servers", 0)
        if not num_servers:
            return "warning", "no registration server on the graph", values
        if lost := self._missing.lost:
            return "warning", lost, values
        return "info", self._message, values


def _unanswered(reason: str) -> RegistrationResult:
    return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, reason)


def _names(submap_ids: Sequence[SubmapId]) -> str:
    first = str(submap_ids[0])
    return first if len(submap_ids) == 1 else f"{first} and {len(submap_ids) - 1} more"


def main(argv: Sequence[str] | None = None) -> int:
    """Manage until stopped."""
    return run_node("map_queue_manager", MapQueueManager, argv)
