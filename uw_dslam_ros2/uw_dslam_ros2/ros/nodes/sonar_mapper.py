"""One vehicle's mapper: sensors in; submaps, its own map, odometry and TF out."""

from __future__ import annotations

import functools
import secrets
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import GetSubmap

from uw_dslam_ros2.core.errors import ConfigError, DataError, InvalidInputError
from uw_dslam_ros2.core.findings import SEVERITIES, Finding, Severity
from uw_dslam_ros2.core.mapping import RunBreak, VehicleMapper, VehicleMapperConfig, VehicleRuns
from uw_dslam_ros2.core.pose_graph import compose_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap, SubmapId
from uw_dslam_ros2.io.conventions import correct, correct_mounting
from uw_dslam_ros2.io.drivers import stamp_of
from uw_dslam_ros2.io.feeding import SensorEvent, feed_runs
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.io.readings import PINGS, TransformEvent
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_to_msg,
    odometry_to_msg,
    path_to_msg,
    stamp_to_msg,
    submap_to_msg,
)
from uw_dslam_ros2.ros.plumbing.batched_subscription import subscribe_batched
from uw_dslam_ros2.ros.plumbing.convention_watch import ConventionWatch
from uw_dslam_ros2.ros.plumbing.diagnostics import Diagnostics, Report
from uw_dslam_ros2.ros.plumbing.frames import (
    WARNING_PERIOD_S,
    FrameBroadcaster,
    Transforms,
    transform_to_msg,
)
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, LATCHED, SERVICES, SUBMAPS, sensor_qos
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.ros.plumbing.sensor_inputs import SensorInput, default_inputs, found_inputs
from uw_dslam_ros2.ros.plumbing.stamp_order import StampOrder
from uw_dslam_ros2.ros.plumbing.throttle import Throttle
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["SonarMapper", "SonarMapperConfig", "main"]

_JUMP_BACK_S = 1.0  # stamps that go back by more are late, or show a clock that was set
_MANY_DISPLACED = 50
_PATH_MAX_POSES = 2000  # a longer path is thinned when published
_MAX_AHEAD_NS = 10_000_000_000
_MOUNT_PATIENCE_NS = 5_000_000_000
_ODOM_PERIOD_NS = 100_000_000
_FINISH_TIMEOUT_S = 600.0
_SILENT_S, _LOST_S = 5.0, 30.0  # a sensor's silence that is a warning, and an error
_USUAL_PERIODS = 5.0
_IDLE_S = 4.0  # longer than the repair of a lost message takes


class SonarMapper(Node):
    """Drives a `VehicleMapper`; all topics are relative, so that a namespace makes a vehicle."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sonar_mapper", **kwargs)
        self._config = declare_config(self, SonarMapperConfig)
        self._mapper_config = declare_config(self, VehicleMapperConfig, "mapper")
        refuse_unknown_parameters(self)
        self._vehicle_id = self._config.vehicle_id or self.get_namespace().strip("/")
        if not self._vehicle_id:
            raise ConfigError(
                "parameter vehicle_id is empty and the node has no namespace; "
                "give one of them (-r __ns:=/auv_1)"
            )
        self._base_frame = self._config.base_frame or f"{self._vehicle_id}/base_link"
        self._map_frame = self._config.map_frame or f"{self._vehicle_id}/map"
        self._odom_frame = self._config.odom_frame or f"{self._vehicle_id}/odom"
        self._T_odom_base = self._T_odom_run = SE2()
        self._smooth_mapper: VehicleMapper | None = None
        self._sent: set[SubmapId] = set()
        self._runs = VehicleRuns(self._mapper_config, self._vehicle_id, _draw_run_id)
        self._order: StampOrder[SensorEvent] = StampOrder(
            int(self._reorder_s() * 1e9),
            int(_JUMP_BACK_S * 1e9),
            int(self._mapper_config.max_gap_s * 1e9),
        )
        self._counts: Counter[str] = Counter()
        self._mapper_values: dict[str, float | int | str] = {}
        self._last_problem = self._problem = ""
        self._odom_stamp_ns = 0
        self._map_stamp_ns = 0
        self._drawing = Throttle(self._config.map_period_s)
        self._is_finished = False
        self._num_breaks_told = 0
        self._heard_s = time.monotonic()
        self._worker = Worker("mapper", self._on_worker_error)
        self._watch = ConventionWatch(
            self._mapper_config.sonar, self._vehicle_id, self._on_convention, self._on_worker_error
        )
        self._create_publishers()
        group = MutuallyExclusiveCallbackGroup()
        self._mountings = Mountings(self._base_frame)
        self._mounting_problem = ""
        self._told: set[str] = set()
        self._transforms = Transforms(
            self,
            self._vehicle_id,
            lambda event: self._worker.post(functools.partial(self._mount, event)),
            callback_group=group,
        )
        self._group = group
        self._inputs: dict[str, SensorInput] = {}
        self._subscriptions_of: dict[str, Subscription] = {}
        self._heard: dict[str, _Heard] = {}
        for sensor in default_inputs(self._config, self._vehicle_id, self._on_finding):
            self._subscribe(sensor)
        self.create_service(
            Trigger, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup()
        )
        self.create_service(
            GetSubmap,
            "~/get_submap",
            self._on_get_submap,
            qos_profile=SERVICES,
            callback_group=ReentrantCallbackGroup(),
        )
        self._diagnostics = Diagnostics(self, self._report, self._vehicle_id)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._on_idle_timer, clock=steady, callback_group=group)
        self.create_timer(1.0, self._on_discovery_timer, clock=steady, callback_group=group)
        self.get_logger().info(
            f"mapping {self._vehicle_id} from {self._config.input}, body frame {self._base_frame}"
        )

    def stop(self) -> None:
        """End the worker after the job at hand."""
        self._worker.close(timeout_s=5.0)
        self._watch.close()

    def destroy_node(self) -> None:
        """Stop, then destroy."""
        self.stop()
        super().destroy_node()

    @property
    def _mapper(self) -> VehicleMapper:
        """Of the run that goes on."""
        return self._runs.mapper

    def _reorder_s(self) -> float:
        """Live, a sensor that died must not hold up the others for long; in a replay it may."""
        live_s, replay_s = 1.0, 60.0
        return self._config.reorder_s or (replay_s if self._config.is_reliable else live_s)

    def _create_publishers(self) -> None:
        self._submap_pub = self.create_publisher(SubmapMsg, "submap", SUBMAPS)
        self._map_pub = self.create_publisher(OccupancyGrid, "map", LATCHED)
        self._path_pub = self.create_publisher(Path, "path", LATCHED)
        self._odom_pub = self.create_publisher(Odometry, "odom", DEFAULT)
        self._broadcaster = FrameBroadcaster(self) if self._config.publishes_tf else None

    def _subscribe(self, sensor: SensorInput) -> None:
        """Listen to a topic, and no more to the one that had its role before."""
        msg_type = sensor.msg_type
        if old := self._subscriptions_of.pop(sensor.role, None):
            self.destroy_subscription(old)
        self._inputs[sensor.role] = sensor
        qos = sensor_qos(sensor.queue_depth, is_reliable=self._config.is_reliable)
        take = functools.partial(self._on_message, sensor)
        self._subscriptions_of[sensor.role] = subscribe_batched(
            self, msg_type, sensor.topic, take, qos, self._group
        )

    def _on_discovery_timer(self) -> None:
        """Find sensors whose topics have other names or types than the usual ones."""
        own = {self.resolve_topic_name(name) for name in ("odom", "map", "path", "submap")}
        namespace = self.get_namespace().strip("/")
        wanted = self._config.topics.chosen().values()
        table = {}
        for topic, _ in self.get_topic_names_and_types():
            is_mine = not namespace or topic.startswith(f"/{namespace}/") or topic in wanted
            senders = self.get_publishers_info_by_topic(topic) if is_mine else []
            if senders and topic not in own:
                table[topic] = senders[0].topic_type
        try:
            found = found_inputs(
                self._config, self._vehicle_id, namespace, table, self._on_finding
            )
            for sensor in found:
                if not self._is_sent(self._inputs.get(sensor.role)):
                    self._subscribe(sensor)
                    self.get_logger().info(f"{sensor.name} is {sensor.topic} ({sensor.msgtype})")
        except DataError as error:
            # A topic that is set may still come.
            is_waiting = "no topic" in str(error)
            self._problem = self._problem if is_waiting else str(error)

    def _is_sent(self, sensor: SensorInput | None) -> bool:
        """Whether somebody sends what is listened to."""
        if sensor is None:
            return False
        senders = self.get_publishers_info_by_topic(self.resolve_topic_name(sensor.topic))
        return any(info.topic_type == sensor.msgtype for info in senders)

    def _on_finding(self, finding: Finding) -> None:
        if finding.severity != "info":
            self._problem = finding.sentence
            self.get_logger().warning(finding.sentence, throttle_duration_sec=WARNING_PERIOD_S)

    def _on_convention(self, finding: Finding) -> None:
        self.get_logger().warning(finding.sentence)

    # --- messages to events ------------------------------------------------------------------

    def _on_message(self, sensor: SensorInput, msg: Any) -> None:
        name = sensor.name
        self._counts[f"num_{name}"] += 1
        self._heard_s = time.monotonic()
        self._heard.setdefault(name, _Heard(self._heard_s)).hear(self._heard_s)
        now_ns = self.get_clock().now().nanoseconds
        try:
            self._check_stamp(msg)
            said = sensor.to_events(msg, now_ns)
        except InvalidInputError as error:
            self._complain(f"bad message on {name}: {error}")
            return
        except (ValueError, TypeError, OverflowError) as error:
            self._complain(f"bad message on {name}: {type(error).__name__}: {error}")
            return
        stamp_ns = stamp_of(msg) or now_ns
        usual = [correct(event, self._config.conventions) for event in said]
        events = [event for event in usual if event is not None]
        if not events:
            self._counts["num_no_velocity"] += sensor.role == "velocity"
            self._worker.post(functools.partial(self._take, name, stamp_ns, None))
        for event in events:
            self._worker.post(functools.partial(self._take, name, event.stamp_ns, event))

    def _check_stamp(self, msg: Any) -> None:
        if not hasattr(msg, "header"):
            return
        stamp_ns = stamp_of(msg)
        if stamp_ns <= 0:
            raise InvalidInputError(
                f"header.stamp is {stamp_ns * 1e-9} s, expected the time of the measurement"
            )
        now_ns = self.get_clock().now().nanoseconds
        if 0 < now_ns < stamp_ns - _MAX_AHEAD_NS:
            raise InvalidInputError(
                f"header.stamp is {(stamp_ns - now_ns) * 1e-9:.1f} s ahead of the clock, "
                f"expected at most {_MAX_AHEAD_NS * 1e-9:.0f} s"
            )

    def _complain(self, text: str) -> None:
        self._counts["num_bad"] += 1
        self._last_problem = text
        self.get_logger().error(text, throttle_duration_sec=WARNING_PERIOD_S)

    def _on_worker_error(self, error: Exception) -> None:
        self._complain(f"{type(error).__name__}: {error}")

    # --- in the worker's thread --------------------------------------------------------------

    def _take(self, stream: str, stamp_ns: int, event: SensorEvent | None) -> None:
        """Put an event in line; None only says how far the stream has come."""
        if self._order.newest_ns is None:
            self._expect_streams(stamp_ns)
        if self._order.offer(stream, stamp_ns, event):
            self._begin_anew(stream, stamp_ns)
        if self._is_finished:
            self._complain(f"mapping was finished; messages on {stream} are left out")
            return
        if self._order.displaced.get(stream, 0) > _MANY_DISPLACED:
            self._complain(
                f"the stamps of {stream} have jumped, and those of other sensors have not: its "
                "messages are left out; are the clocks of both computers set?"
            )
        self._drain()

    def _expect_streams(self, stamp_ns: int) -> None:
        """At the start, wait for the first message of every sensor that somebody sends."""
        for sensor in list(self._inputs.values()):
            if self.count_publishers(sensor.topic):
                self._order.expect(sensor.name, stamp_ns - 1)  # its own may be of the same moment

    def _begin_anew(self, stream: str, stamp_ns: int) -> None:
        """The clock was set, or a recording began again: what was mapped is kept as a run."""
        newest_ns = self._order.newest_ns or stamp_ns
        for event in self._order.rest():
            self._feed(event)
        self._order.begin_anew()
        way = "back" if stamp_ns < newest_ns else "ahead"
        self.get_logger().warning(
            f"the clock went {way} by {abs(stamp_ns - newest_ns) * 1e-9:.1f} s (on {stream}): a "
            "new run begins; what was mapped before is kept, and only registration joins the two"
        )
        reason = RunBreak("", newest_ns, stamp_ns)
        self._publish_submaps(self._runs.begin(reason))
        self._odom_stamp_ns = self._map_stamp_ns = 0
        self._is_finished = False
        self._counts["num_restarts"] += 1

    def _on_idle_timer(self) -> None:
        """When nothing comes any more, what was held back for others is used all the same."""
        if time.monotonic() - self._heard_s > _IDLE_S:
            self._worker.post(self._flush)

    def _flush(self) -> None:
        for event in self._order.rest():
            self._feed(event)
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is not None and stamp_ns > self._map_stamp_ns:
            self._publish_map(stamp_ns)

    def _drain(self) -> None:
        """Feed what is due, in the order of the stamps."""
        while (event := self._order.peek()) is not None:
            newest_ns = self._order.newest_ns or event.stamp_ns
            is_patient = newest_ns - event.stamp_ns < _MOUNT_PATIENCE_NS
            if is_patient and not self._mountings.is_known(event):
                return  # /tf_static is on its way
            self._feed(self._order.pop())

    def _mount(self, event: TransformEvent) -> None:
        """Take a transform, and go on with what waited for it."""
        self._mountings.add(event)
        self._drain()

    def _tell_mountings(self) -> None:
        """Say so where a frame's place is not known, or a sonar looks up or down."""
        findings = self._mountings.findings(self._vehicle_id)
        self._mounting_problem = findings[0].sentence if findings else ""
        for finding in findings:
            if finding.sentence not in self._told:
                self._told.add(finding.sentence)
                self.get_logger().warning(finding.sentence)

    def _feed(self, event: SensorEvent) -> None:
        T_base_sensor = self._mountings.of(event)
        self._tell_mountings()
        try:
            mounting = correct_mounting(event, T_base_sensor, self._config.conventions)
            submaps = feed_runs(self._runs, event, mounting)
            self._watch.take(event, mounting)
        except InvalidInputError as error:
            self._complain(f"{type(event).__name__} of {event.frame_id}: {error}")
            return
        self._publish_submaps(submaps)
        self._note_breaks()
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is None:
            return
        if stamp_ns - self._odom_stamp_ns >= _ODOM_PERIOD_NS:
            self._publish_odometry(stamp_ns)
        if isinstance(event, PINGS):
            self._mapper_values = self._runs.diagnostics()
            is_old = stamp_ns - self._map_stamp_ns >= self._config.map_period_s * 1e9
            if is_old and self._drawing.is_due():
                self._publish_map(stamp_ns)

    def _note_breaks(self) -> None:
        """Say so where a silence has begun a new run."""
        for reason in self._runs.breaks[self._num_breaks_told :]:
            self._odom_stamp_ns = self._map_stamp_ns = 0
            if reason.role:
                what = "heading" if reason.role == "imu" else "velocity"
                self._last_problem = (
                    f"no {what} for {reason.seconds:.0f} s: a new run begins; what was mapped "
                    "before is kept, and only registration joins the two"
                )
                self.get_logger().warning(self._last_problem)
        self._num_breaks_told = len(self._runs.breaks)

    def _finish(self) -> str:
        if self._is_finished:
            return "finished before; nothing changes"
        self._flush()
        submaps = self._runs.finish()
        self._publish_submaps(submaps)
        self._is_finished = True
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is not None:
            self._publish_map(stamp_ns)
        self._mapper_values = self._runs.diagnostics()
        return (
            f"{self._mapper_values['num_pings']} pings mapped into "
            f"{self._mapper_values['num_submaps']} submaps; {self._counts['num_bad']} bad messages"
        )

    def _publish_submaps(self, submaps: Iterable[Submap]) -> None:
        for submap in submaps:
            self._counts["num_submap_messages"] += 1
            # What is closed moves, and changes no more: a grid is a megabyte.
            is_known = submap.submap_id in self._sent
            self._counts["num_pose_messages"] += is_known
            self._submap_pub.publish(submap_to_msg(submap, is_pose_only=is_known))
            self._sent.add(submap.submap_id)

    def _publish_odometry(self, stamp_ns: int) -> None:
        self._odom_stamp_ns = stamp_ns
        stamp = stamp_to_msg(stamp_ns)
        mapper = self._mapper
        if self._smooth_mapper is not mapper:
            # A new run begins at its own zero; odometry goes on from where it was.
            self._T_odom_run = self._T_odom_base @ mapper.T_smooth_base.inverse()
            self._smooth_mapper = mapper
        self._T_odom_base = self._T_odom_run @ mapper.T_smooth_base
        msg = odometry_to_msg(
            self._T_odom_base,
            _turned(mapper.smooth_covariance, self._T_odom_run),
            *mapper.velocity,
            mapper.velocity_covariance,
            mapper.depth_m,
        )
        msg.header.stamp = stamp
        msg.header.frame_id, msg.child_frame_id = self._odom_frame, self._base_frame
        self._odom_pub.publish(msg)
        if self._broadcaster is not None:
            # Loop closures, and where a new run lies, move the frame and not the odometry.
            T_map_odom = mapper.T_odom_base @ self._T_odom_base.inverse()
            T_odom_base = transform_to_msg(
                stamp, self._odom_frame, self._base_frame, self._T_odom_base
            )
            T_odom_base.transform.translation.z = msg.pose.pose.position.z
            self._broadcaster.send(
                transform_to_msg(stamp, self._map_frame, self._odom_frame, T_map_odom),
                T_odom_base,
            )

    def _publish_map(self, stamp_ns: int) -> None:
        self._map_stamp_ns = stamp_ns
        stamps_ns, poses = self._mapper.trajectory()
        if not len(poses):
            return
        frame_id = self._map_frame
        with self._drawing.turn():
            occupancy = self._mapper.vehicle_map()
            self._map_pub.publish(occupancy_to_msg(occupancy, frame_id, stamp_ns))
            self._path_pub.publish(
                path_to_msg(stamps_ns, poses, frame_id, stamp_ns, _PATH_MAX_POSES)
            )

    # --- services and diagnostics ------------------------------------------------------------

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = self._worker.call(self._finish).result(_FINISH_TIMEOUT_S)
            response.success = True
        except Exception as error:  # noqa: BLE001 (the caller gets it)
            response.success = False
            response.message = f"{type(error).__name__}: {error}"
        self.get_logger().info(f"finish: {response.message}")
        return response

    def _on_get_submap(
        self, request: GetSubmap.Request, response: GetSubmap.Response
    ) -> GetSubmap.Response:
        """Give a submap again, to whoever did not get it."""
        try:
            found = self._worker.call(lambda: self._issued(request)).result(_FINISH_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001 (the caller gets it)
            found, response.message = None, f"{type(error).__name__}: {error}"
        response.result = response.NOT_FOUND
        if found is not None:
            response.result, response.submap = response.DONE, submap_to_msg(found)
        elif not response.message:
            response.message = f"this run of {self._vehicle_id} has no submap {request.sequence}"
        return response

    def _issued(self, request: GetSubmap.Request) -> Submap | None:
        if request.vehicle_id != self._vehicle_id:
            return None
        return self._runs.issued(int(request.run_id), int(request.sequence))

    def _report(self) -> Report:
        for sensor in list(self._inputs.values()):
            topic = self.resolve_topic_name(sensor.topic)
            for info in self.get_publishers_info_by_topic(topic):
                if info.topic_type != sensor.msgtype:
                    self._complain(
                        f"topic {topic} has type {info.topic_type}, expected {sensor.msgtype}"
                    )
        values = {
            **dict(sorted(self._counts.items())),
            "num_frames": self._mountings.num_frames,
            "num_late": self._order.num_late,
            "num_waiting": self._worker.num_waiting,
            **self._mapper_values,
        }
        num_pings = self._mapper_values.get("num_pings", 0)
        problem = self._last_problem or self._problem or self._mounting_problem
        severity, silence = self._silence()
        if conventions := self._watch.sentence:
            severity = max(severity, "warning", key=SEVERITIES.index)
            problem = conventions
        if not num_pings:
            text = problem or "no ping mapped yet"
            return max(severity, "warning", key=SEVERITIES.index), silence or text, values
        return severity, silence or problem or f"{num_pings} pings mapped", values

    def _silence(self) -> tuple[Severity, str]:
        """How bad it is that sensors which were heard are heard no more, and which."""
        if self._is_finished:
            return "info", ""
        now_s = time.monotonic()
        ages = {name: heard.silence_s(now_s) for name, heard in list(self._heard.items())}
        silent = {name: age_s for name, age_s in ages.items() if age_s > _SILENT_S}
        if not silent:
            return "info", ""
        text = "; ".join(f"{name}: no message for {age_s:.0f} s" for name, age_s in silent.items())
        return "error" if max(silent.values()) > _LOST_S else "warning", text


def _turned(covariance: NDArray[np.float64], T_odom_run: SE2) -> NDArray[np.float64]:
    """The covariance (3, 3) of a pose in the run's own frame, in odom."""
    return compose_covariance(covariance, T_odom_run, SE2(), SE2())


def _draw_run_id() -> int:
    """Different also for two mappers that start in the same moment."""
    return 1 + secrets.randbelow(MAX_RUN_ID)


@dataclass(slots=True)
class _Heard:
    """When a sensor was heard, by a steady clock."""

    first_s: float
    last_s: float = 0.0
    num: int = 0

    def hear(self, now_s: float) -> None:
        self.last_s = now_s
        self.num += 1

    def silence_s(self, now_s: float) -> float:
        """Time since the last message; 0 as long as that is usual for this sensor."""
        period_s = (self.last_s - self.first_s) / max(1, self.num - 1)
        age_s = now_s - self.last_s
        return age_s if age_s > _USUAL_PERIODS * period_s else 0.0


def main(argv: Sequence[str] | None = None) -> int:
    """Map until stopped."""
    return run_node("sonar_mapper", SonarMapper, argv)
