"""One vehicle's mapper: sensors in; submaps, its own map, odometry and TF out."""

from __future__ import annotations

import functools
import secrets
import time
from collections.abc import Sequence
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType

from uw_dslam_ros2.core.errors import ConfigError, DataError, InvalidInputError
from uw_dslam_ros2.core.findings import Severity
from uw_dslam_ros2.core.mapping import RunBreak, VehicleMapper, VehicleMapperConfig, VehicleRuns
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap
from uw_dslam_ros2.io.conventions import CorrectedMountings, correct
from uw_dslam_ros2.io.drivers import stamp_of
from uw_dslam_ros2.io.feeding import SensorEvent, feed_runs
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.io.readings import PINGS, TransformEvent
from uw_dslam_ros2.ros.mapper.convention_watch import ConventionWatch
from uw_dslam_ros2.ros.mapper.last_pass import LastPass
from uw_dslam_ros2.ros.mapper.outputs import MapperOutputs
from uw_dslam_ros2.ros.mapper.run_keeper import RunKeeper
from uw_dslam_ros2.ros.mapper.sensor_silence import SensorSilence
from uw_dslam_ros2.ros.mapper.sensor_topics import SensorTopics
from uw_dslam_ros2.ros.mapper.services import MapperServices
from uw_dslam_ros2.ros.mapper.stamp_order import StampOrder
from uw_dslam_ros2.ros.mapper.troubles import MapperTroubles
from uw_dslam_ros2.ros.plumbing.diagnostics import Report
from uw_dslam_ros2.ros.plumbing.frames import Transforms
from uw_dslam_ros2.ros.plumbing.managed_node import ManagedNode
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.ros.plumbing.sensor_inputs import SensorInput, check_stamp
from uw_dslam_ros2.ros.plumbing.throttle import Throttle
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["SonarMapper", "SonarMapperConfig", "main"]

_JUMP_BACK_S = 1.0  # stamps that go back by more are late, or show a clock that was set
_MANY_DISPLACED = 50
_MOUNT_PATIENCE_NS = 5_000_000_000
_ODOM_PERIOD_NS = 100_000_000
_LAST_WORD_S, _HEARD_S, _CLOSE_S = 1.0, 0.3, 5.0
"""When told to end: to close the open submap, until who listens has it, for the job at hand."""
_IDLE_S = 4.0  # longer than the repair of a lost message takes


class SonarMapper(ManagedNode):
    """Drives a `VehicleMapper`; all topics are relative, so that a namespace makes a vehicle."""

    groups = (("", SonarMapperConfig), ("mapper", VehicleMapperConfig))
    live = frozenset({"map_period_s"})
    why_fixed = "what is mapped so far was mapped with it"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sonar_mapper", **kwargs)

    def set_up(self) -> None:
        """Begin with an empty map."""
        self._config = self.settings(SonarMapperConfig)
        self._mapper_config = self.settings(VehicleMapperConfig)
        self._vehicle_id = self._config.vehicle_id or self.get_namespace().strip("/")
        if not self._vehicle_id:
            raise ConfigError(
                "parameter vehicle_id is empty and the node has no namespace; "
                "give one of them (-r __ns:=/auv_1)"
            )
        self._base_frame = self._config.base_frame or f"{self._vehicle_id}/base_link"
        occupancy = self._mapper_config.occupancy
        self._last_pass = LastPass(occupancy, self.get_logger().warning)
        self._runs = VehicleRuns(
            self._mapper_config, self._vehicle_id, _draw_run_id, self._last_pass.pings
        )
        self._order: StampOrder[SensorEvent] = StampOrder(
            int(self._reorder_s() * 1e9),
            int(_JUMP_BACK_S * 1e9),
            int(self._mapper_config.max_gap_s * 1e9),
        )
        self._troubles = MapperTroubles(self, self._vehicle_id)
        self._keeper = RunKeeper(self._config.session, occupancy, self._troubles.complain)
        self.at_end(self._keeper.close)
        self._mapper_values: dict[str, float | int | str] = {}
        self._odom_stamp_ns = 0
        self._map_stamp_ns = 0
        self._drawing = Throttle(self._config.map_period_s)
        self._is_finished = self._is_paused = False
        self._silence = SensorSilence(time.monotonic())
        self._topics: SensorTopics | None = None
        self._worker = Worker("mapper", self._troubles.complain_of)
        self.at_end(lambda: self._worker.close(_CLOSE_S))
        self._watch = ConventionWatch(
            self._mapper_config.sonar,
            self._vehicle_id,
            self._troubles.note_convention,
            self._troubles.complain_of,
        )
        self.at_end(self._watch.close)
        self._outputs = MapperOutputs(self, self._config, self._vehicle_id, self._base_frame)
        self.at_end(self._say_last)
        self._group = MutuallyExclusiveCallbackGroup()
        self._mountings = Mountings(self._base_frame)
        self._corrected = CorrectedMountings(self._config.conventions)
        self._transforms = Transforms(
            self,
            self._vehicle_id,
            lambda event: self._worker.post(functools.partial(self._mount, event)),
            callback_group=self._group,
        )
        MapperServices(self, self, self._worker)
        self.tell_health(self._report, self._vehicle_id)

    def begin(self) -> None:
        """Listen to the sensors."""
        self._silence = SensorSilence(time.monotonic())
        self._topics = SensorTopics(
            self,
            self._config,
            self._vehicle_id,
            self._on_message,
            self._troubles.note_finding,
            MapperOutputs.TOPICS,
            self._group,
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._on_idle_timer, clock=steady, callback_group=self._group)
        self.create_timer(1.0, self._on_discovery_timer, clock=steady, callback_group=self._group)
        self.get_logger().info(
            f"mapping {self._vehicle_id} from {self._config.input}, body frame {self._base_frame}"
        )

    def rest(self) -> None:
        """Listen no more; a heading that is missing for long begins a new run."""
        if self._topics is not None:
            self._topics.stop()

    def _say_last(self) -> None:
        """Give the open submap away, if there is time."""
        if self._is_finished:
            return
        job = self._worker.call(self._close_last)
        try:
            job.result(_LAST_WORD_S)
        except Exception as error:  # noqa: BLE001 (it ends in any case)
            job.cancel()
            self.get_logger().warning(f"the open submap is lost: {error or type(error).__name__}")
        else:
            self._outputs.wait_for_readers(_HEARD_S)

    def settings_changed(self) -> None:
        """From the next map on."""
        self._config = self.settings(SonarMapperConfig)
        self._drawing = Throttle(self._config.map_period_s)

    @property
    def _mapper(self) -> VehicleMapper:
        """Of the run that goes on."""
        return self._runs.mapper

    def _reorder_s(self) -> float:
        """Live, a sensor that died must not hold up the others for long; in a replay it may."""
        live_s, replay_s = 1.0, 60.0
        return self._config.reorder_s or (replay_s if self._config.is_reliable else live_s)

    def _on_discovery_timer(self) -> None:
        if self._topics is None or not self.is_active:
            return
        try:
            self._topics.discover()
        except DataError as error:
            # A topic that is set may still come.
            if "no topic" not in str(error):
                self._troubles.note_topics(str(error))

    # --- messages to events ------------------------------------------------------------------

    def _on_message(self, sensor: SensorInput, msg: Any) -> None:
        if not self.is_active:
            return
        name = sensor.name
        self._troubles.counts[f"num_{name}"] += 1
        self._silence.hear(name, time.monotonic())
        now_ns = self.get_clock().now().nanoseconds
        try:
            check_stamp(msg, now_ns)
            said = sensor.to_events(msg, now_ns)
        except InvalidInputError as error:
            self._troubles.complain(f"bad message on {name}: {error}")
            return
        except (ValueError, TypeError, OverflowError) as error:
            self._troubles.complain(f"bad message on {name}: {type(error).__name__}: {error}")
            return
        stamp_ns = stamp_of(msg) or now_ns
        usual = [correct(event, self._config.conventions) for event in said]
        events = [event for event in usual if event is not None]
        if sensor.role == "sonar" and self._is_paused:
            self._troubles.counts["num_pings_paused"] += len(events)
            events = []
        if not events:
            self._troubles.counts["num_no_velocity"] += sensor.role == "velocity"
            self._worker.post(functools.partial(self._take, name, stamp_ns, None))
        for event in events:
            self._worker.post(functools.partial(self._take, name, event.stamp_ns, event))

    # --- in the worker's thread --------------------------------------------------------------

    def _take(self, stream: str, stamp_ns: int, event: SensorEvent | None) -> None:
        """Put an event in line; None only says how far the stream has come."""
        if self._order.newest_ns is None:
            self._expect_streams(stamp_ns)
        if self._order.offer(stream, stamp_ns, event):
            self._begin_anew(stream, stamp_ns)
        if self._is_finished:
            self._troubles.complain(f"mapping was finished; messages on {stream} are left out")
            return
        if self._order.displaced.get(stream, 0) > _MANY_DISPLACED:
            self._troubles.complain(
                f"the stamps of {stream} have jumped, and those of other sensors have not: its "
                "messages are left out; are the clocks of both computers set?"
            )
        self._drain()

    def _expect_streams(self, stamp_ns: int) -> None:
        """At the start, wait for the first message of every sensor that somebody sends."""
        for sensor in self._topics.inputs() if self._topics is not None else ():
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
        self._begin_run(RunBreak("", newest_ns, stamp_ns))

    def _begin_run(self, reason: RunBreak) -> None:
        self._give(self._runs.begin(reason))
        self._odom_stamp_ns = self._map_stamp_ns = 0
        self._is_finished = False
        self._troubles.counts["num_restarts"] += 1

    def _on_idle_timer(self) -> None:
        """When nothing comes any more, what was held back for others is used all the same."""
        if time.monotonic() - self._silence.last_s > _IDLE_S:
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

    def _feed(self, event: SensorEvent) -> None:
        T_base_sensor = self._mountings.of(event)
        self._troubles.note_mountings(self._mountings)
        try:
            mounting = self._corrected.of(event, T_base_sensor)
            if mounting is None:
                return
            submaps = feed_runs(self._runs, event, mounting)
            self._watch.take(event, mounting)
        except InvalidInputError as error:
            self._troubles.complain(f"{type(event).__name__} of {event.frame_id}: {error}")
            return
        self._give(submaps)
        self._last_pass.look()
        if self._troubles.note_breaks(self._runs):
            self._odom_stamp_ns = self._map_stamp_ns = 0
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is None:
            return
        if stamp_ns - self._odom_stamp_ns >= _ODOM_PERIOD_NS:
            self._odom_stamp_ns = stamp_ns
            self._outputs.publish_odometry(self._mapper, stamp_ns)
        if isinstance(event, PINGS):
            self._mapper_values = self._runs.diagnostics()
            is_old = stamp_ns - self._map_stamp_ns >= self._config.map_period_s * 1e9
            if is_old and self._drawing.is_due():
                self._publish_map(stamp_ns)

    def _publish_map(self, stamp_ns: int) -> None:
        self._map_stamp_ns = stamp_ns
        with self._drawing.turn():
            self._outputs.publish_map(self._mapper, stamp_ns)

    # --- what the services ask for -----------------------------------------------------------

    def pause(self, is_paused: bool) -> str:
        """Leave out the pings that come from now on; navigation, and so the run, goes on."""
        self._is_paused = is_paused
        return "pings are left out" if is_paused else "pings are mapped"

    def issued(self, vehicle_id: str, run_id: int, sequence: int) -> Submap | None:
        """A submap as it was given away last; run 0 is the one that goes on."""
        return self._runs.issued(run_id, sequence) if vehicle_id == self._vehicle_id else None

    def reset(self) -> str:
        """Begin anew; what was mapped before goes to who listens, and stays there."""
        stamp_ns = self._mapper.stamp_ns or 0
        self._begin_run(RunBreak("", stamp_ns, stamp_ns))
        return f"a new run begins; {self._runs.diagnostics()['num_submaps']} submaps lie before it"

    def finish(self) -> str:
        """Close the last submap, and draw all of them anew; nothing is mapped after that."""
        if self._is_finished:
            return "finished before; nothing changes"
        self._flush()
        before = self._mapper.trajectory()[1]
        self._close_last()
        drawn_anew = self._last_pass.draw(self._runs.mappers())
        self._outputs.publish_submaps(drawn_anew, is_drawn_anew=True)
        self._keeper.forget_own()
        num_earlier = 0
        for earlier in self._keeper.earlier_drawn_anew():
            self._outputs.publish_submaps(earlier, is_drawn_anew=True)
            num_earlier += len(earlier)
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is not None:
            self._publish_map(stamp_ns)
            # Who buffers transforms keeps the first of each stamp.
            after = self._mapper.trajectory()[1]
            self._outputs.correct_frames(before, after, stamp_ns + 1)
        self._mapper_values = self._runs.diagnostics()
        return (
            f"{self._mapper_values['num_pings']} pings mapped into "
            f"{self._mapper_values['num_submaps']} submaps, {len(drawn_anew)} of them drawn anew"
            f"{f', and {num_earlier} of before it was started' if num_earlier else ''}; "
            f"{self._troubles.counts['num_bad']} bad messages"
        )

    def _close_last(self) -> None:
        self._flush()
        self._give(self._runs.finish())
        self._is_finished = True

    def _give(self, submaps: list[Submap]) -> None:
        """Give submaps away; a process that is killed in between has kept them."""
        self._keeper.keep(submaps, self._last_pass.pings.of_submap)
        self._outputs.publish_submaps(submaps)

    # --- diagnostics -------------------------------------------------------------------------

    def _report(self) -> Report:
        for misfit in self._topics.misfits() if self._topics is not None else ():
            self._troubles.complain(misfit)
        values: dict[str, float | int | str] = {
            **dict(sorted((self._troubles.counts + self._outputs.counts).items())),
            "num_bad": self._troubles.counts["num_bad"],
            "num_frames": self._mountings.num_frames,
            "num_late": self._order.num_late,
            "num_waiting": self._worker.num_waiting,
            "num_pings_not_kept": self._last_pass.pings.num_left_out,
            **self._mapper_values,
        }
        silence: tuple[Severity, str] = ("info", "")
        if not self._is_finished:
            silence = self._silence.judge(time.monotonic())
        return self._troubles.report(
            values, silence, self._watch.sentence, is_paused=self._is_paused
        )


def _draw_run_id() -> int:
    """Different also for two mappers that start in the same moment."""
    return 1 + secrets.randbelow(MAX_RUN_ID)


def main(argv: Sequence[str] | None = None) -> int:
    """Map until stopped."""
    return run_node("sonar_mapper", SonarMapper, argv)
