"""Collects the submaps of all vehicles, has them registered, and publishes one global map."""

from __future__ import annotations

import functools
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import GrowingMapConfig, MapChange, MapQueue, MapQueueConfig
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.sessions.session import load_session
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg, submap_id_of
from uw_dslam_ros2.ros.manager.fix_inputs import FixInputs
from uw_dslam_ros2.ros.manager.group_maps import GroupMaps
from uw_dslam_ros2.ros.manager.map_inputs import MapInputs
from uw_dslam_ros2.ros.manager.map_publisher import MapPublisher
from uw_dslam_ros2.ros.manager.missing_submaps import MissingSubmaps
from uw_dslam_ros2.ros.manager.outputs import QueueFrames, StatusPublisher
from uw_dslam_ros2.ros.manager.requests import QueueRequests
from uw_dslam_ros2.ros.manager.services import QueueServices
from uw_dslam_ros2.ros.manager.session_keeper import SessionKeeper
from uw_dslam_ros2.ros.manager.shared_decisions import SharedDecisions
from uw_dslam_ros2.ros.plumbing.diagnostics import Report
from uw_dslam_ros2.ros.plumbing.frames import WARNING_PERIOD_S
from uw_dslam_ros2.ros.plumbing.idle_timeout import IdleTimeout
from uw_dslam_ros2.ros.plumbing.managed_node import ManagedNode
from uw_dslam_ros2.ros.plumbing.node_settings import MapQueueManagerConfig
from uw_dslam_ros2.ros.plumbing.qos import SUBMAPS
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.ros.plumbing.throttle import Throttle
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["MapQueueManager", "MapQueueManagerConfig", "main"]

_SUBMAP_TYPE = "uw_dslam_msgs/msg/Submap"
_TICK_S = 0.1
_STATUS_PERIOD_S = 1.0
_DISCOVERY_PERIOD_S = 0.5
_CLOSE_S = 10.0
"""Longest wait for the job at hand."""


class MapQueueManager(ManagedNode):
    """Drives a `MapQueue` in a thread of its own; callbacks only hand it work."""

    num_threads = 8
    groups = (("", MapQueueManagerConfig), ("queue", MapQueueConfig), ("maps", GrowingMapConfig))
    live = frozenset(
        {
            "requests_per_server",
            "request_timeout_s",
            "quiet_s",
            "publish_period_s",
            "full_map_period_s",
        }
    )
    why_fixed = "the map so far was made with it"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("map_queue_manager", **kwargs)

    def set_up(self) -> None:
        """Go on with the session, and make what takes, asks and tells."""
        self._config = self.settings(MapQueueManagerConfig)
        self._queue_config = self.settings(MapQueueConfig)
        self._queue = MapQueue(self._queue_config)
        self._message = "waiting for submaps"
        self._idle = IdleTimeout(self._config.quiet_s)
        self._counts: Counter[str] = Counter()
        self._is_changed = True
        self._status_s = self._discovered_s = float("-inf")
        self._is_tick_posted = threading.Event()
        self._keeper = SessionKeeper(self._config.session, self.complain)
        self._worker = Worker("map queue", self._on_worker_error)
        self.at_end(lambda: self._keeper.close(self._queue))
        self.at_end(lambda: self._worker.close(_CLOSE_S))
        self._resume()
        self._group = ReentrantCallbackGroup()
        self._map = MapPublisher(self, self._config.map_frame, self._config.full_map_period_s)
        self._group_maps = GroupMaps(self, self._config.map_frame)
        self._status = StatusPublisher(self, self._config.map_frame)
        self._topics: set[str] = set()
        self._owners: dict[str, str] = {}
        self._requests = QueueRequests(self, self, self._config, self._worker.post)
        self._shared_decisions = SharedDecisions(self, self._config.link, self, self._worker.post)
        self._missing = MissingSubmaps(
            self, self._worker.post, self._on_submap, lambda text: self._queue.in_words(text)
        )
        self._maps = MapInputs(
            self,
            self._config.map_topics,
            is_discovering=self._config.is_discovering_maps,
            config=self.settings(GrowingMapConfig),
            post=self._worker.post,
            on_change=self._on_map_change,
            on_growth=lambda: self._idle.note(time.monotonic()),
            complain=self.complain,
            submaps_of=self._submaps_of,
        )
        self._fixes = FixInputs(
            self,
            self._config.fix_topics,
            self._config.fix_sigma_m,
            self._worker.post,
            self.complain,
        )
        self._frames = (
            QueueFrames(self, self._config.map_frame, self._maps.frame_of)
            if self._config.publishes_tf
            else None
        )
        self.settings_changed()
        QueueServices(self, self, self._worker, self._group)
        self.tell_health(self._report, self._config.map_frame)

    def begin(self) -> None:
        """Take submaps, ask servers, publish."""
        for vehicle_id in self._config.vehicles:
            self._subscribe(f"/{vehicle_id.strip('/')}/submap")
        # Steady: registrations go on when a replay and its clock have ended.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=steady, callback_group=self._group)

    def rest(self) -> None:
        """Submaps that come meanwhile are latched, and asked for where they are not."""
        self._topics.clear()
        self._maps.stop()
        self._fixes.stop()
        self._worker.post(lambda: self._keeper.save_if_due(self._queue))

    def settings_changed(self) -> None:
        """Rates and limits, from now on."""
        self._config = config = self.settings(MapQueueManagerConfig)
        self._idle.set_quiet(config.quiet_s)
        # Drawing a large map takes a second: questions and answers come first.
        self._drawing = Throttle(config.publish_period_s)
        self._map.set_full_period(config.full_map_period_s)
        self._requests.set_limits(config)

    # --- callbacks ---------------------------------------------------------------------------

    def _subscribe(self, topic: str) -> None:
        if topic in self._topics or not self.is_active:
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
        if not self.is_active:
            return
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

    # --- in the worker's thread: submaps ----------------------------------------------------

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
            self.complain(self._queue.in_words(f"submap refused on {topic}: {error}"))
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
        self._requests.note_change()
        self._shared_decisions.note_change()
        self._keeper.note_change()
        self._fixes.note_change()

    def _tick(self) -> None:
        self._is_tick_posted.clear()
        if not self.is_active:
            return
        now_s = time.monotonic()
        if now_s - self._discovered_s >= _DISCOVERY_PERIOD_S:
            self._discovered_s = now_s
            self._discover()
            self._missing.look(self._queue.missing())
        if not self._idle.is_active(now_s):
            self._maps.rest()
        self._queue.is_growing = self._idle.is_active(now_s)
        self._shared_decisions.look()
        for notice in self._queue.take_notices():
            self._message = notice
            self.get_logger().warning(self._queue.in_words(notice))
        fixes = self._fixes.due(lambda: (record.submap for record in self._queue.submaps()))
        if fixes and self._queue.add_fixes(fixes):
            self.changed(f"{len(fixes)} submaps have position fixes")
        self._requests.look()
        # First saved, then told: what anybody has heard of outlives a kill.
        self._keeper.save_if_due(self._queue)
        if self._is_changed and self._drawing.is_due():
            self._is_changed = False
            with self._drawing.turn() if self._queue.submaps() else nullcontext():
                self._publish_map()
                self._publish_status()
        elif now_s - self._status_s >= _STATUS_PERIOD_S:
            self._publish_status()
        self._map.publish_overdue(self._now())
        if self._frames is not None:
            self._frames.publish(self._queue)

    def _discover(self) -> None:
        self._requests.discover()
        self._maps.look()
        self._fixes.look()
        if not self._config.vehicles:
            for topic, types in self.get_topic_names_and_types():
                if _SUBMAP_TYPE in types:
                    self._subscribe(topic)

    # --- in the worker's thread: what is published -------------------------------------------

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _publish_map(self) -> None:
        self._group_maps.publish(self._queue.submaps(), self._now())
        changed = self._queue.changed_window()
        if changed is None:
            return
        occupancy = self._queue.global_map()
        if occupancy is not None:
            self._map.publish(occupancy, changed[0], self._now())

    def _publish_status(self) -> None:
        self._status_s = time.monotonic()
        self._status.publish(
            self._queue,
            self._requests.num_in_flight,
            self._requests.num_servers,
            self._message,
        )

    # --- what the services ask for -----------------------------------------------------------

    @property
    def queue(self) -> MapQueue:
        """The queue as it is now."""
        return self._queue

    def resume(self, path: str) -> MapQueue:
        """Go on with the session in a folder, in the place of the queue."""
        queue = load_session(path, self._queue_config)
        self._requests.forget_all()
        self._queue = queue
        self._maps.forget()
        self._map.clear()
        self._group_maps.clear()
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
        values = self._status.values | dict(sorted((self._counts + self._requests.counts).items()))
        values["num_jobs_waiting"] = self._worker.num_waiting
        values |= self._missing.values()
        if trouble := self._keeper.trouble:
            return "error", trouble, values
        if not self._status.values.get("num_servers", 0):
            return "warning", "no registration server on the graph", values
        if lost := self._missing.lost:
            return "warning", lost, values
        if aside := self._status.aside:
            return "warning", aside, values
        return "info", self._message, values


def main(argv: Sequence[str] | None = None) -> int:
    """Manage until stopped."""
    return run_node("map_queue_manager", MapQueueManager, argv)
