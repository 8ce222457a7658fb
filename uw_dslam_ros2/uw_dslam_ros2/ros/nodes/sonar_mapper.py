"""One vehicle's mapper: sensors in; submaps, its own map, odometry and TF out."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType

from uw_dslam_ros2.core.errors import ConfigError, DataError, InvalidInputError
from uw_dslam_ros2.core.findings import Severity
from uw_dslam_ros2.core.mapping import VehicleMapperConfig
from uw_dslam_ros2.io.conventions import correct
from uw_dslam_ros2.io.drivers import stamp_of
from uw_dslam_ros2.ros.mapper.outputs import MapperOutputs
from uw_dslam_ros2.ros.mapper.pipeline import MapperPipeline
from uw_dslam_ros2.ros.mapper.sensor_silence import SensorSilence
from uw_dslam_ros2.ros.mapper.sensor_topics import SensorTopics
from uw_dslam_ros2.ros.mapper.services import MapperServices
from uw_dslam_ros2.ros.mapper.troubles import MapperTroubles
from uw_dslam_ros2.ros.plumbing.diagnostics import Report
from uw_dslam_ros2.ros.plumbing.frames import Transforms
from uw_dslam_ros2.ros.plumbing.managed_node import ManagedNode
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.running import run_node
from uw_dslam_ros2.ros.plumbing.sensor_inputs import SensorInput, check_stamp
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["SonarMapper", "SonarMapperConfig", "main"]

_LAST_WORD_S, _HEARD_S, _CLOSE_S = 1.0, 0.3, 5.0
"""When told to end: to close the open submap, until who listens has it, for the job at hand."""
_IDLE_S = 4.0  # longer than the repair of a lost message takes


class SonarMapper(ManagedNode):
    """Wires a `MapperPipeline`; all topics are relative, so that a namespace makes a vehicle."""

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
        self._troubles = MapperTroubles(self, self._vehicle_id)
        self._silence = SensorSilence(time.monotonic())
        self._topics: SensorTopics | None = None
        self._outputs = MapperOutputs(self, self._config, self._vehicle_id, self._base_frame)
        self._pipeline = MapperPipeline(
            self._config,
            self._mapper_config,
            self._vehicle_id,
            self._base_frame,
            self._outputs,
            self._troubles,
            self.get_logger().warning,
            self._streams_sent,
        )
        self.at_end(self._pipeline.close)
        self._worker = Worker("mapper", self._troubles.complain_of)
        self.at_end(lambda: self._worker.close(_CLOSE_S))
        # A long run takes seconds to read, while sensors speak already.
        self._worker.post(self._pipeline.resume)
        self.at_end(self._say_last)
        self._group = MutuallyExclusiveCallbackGroup()
        self._transforms = Transforms(
            self,
            self._vehicle_id,
            lambda event: self._worker.post(functools.partial(self._pipeline.mount, event)),
            callback_group=self._group,
        )
        MapperServices(self, self._pipeline, self._worker)
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
        if self._pipeline.is_finished:
            return
        job = self._worker.call(self._pipeline.close_last)
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
        self._pipeline.set_map_period(self._config.map_period_s)

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
        if sensor.role == "sonar" and self._pipeline.is_paused:
            self._troubles.counts["num_pings_paused"] += len(events)
            events = []
        if not events:
            self._troubles.counts["num_no_velocity"] += sensor.role == "velocity"
            self._worker.post(functools.partial(self._pipeline.take, name, stamp_ns, None))
        for event in events:
            self._worker.post(functools.partial(self._pipeline.take, name, event.stamp_ns, event))

    def _streams_sent(self) -> list[str]:
        """Names of the sensors that somebody sends."""
        sensors = self._topics.inputs() if self._topics is not None else ()
        return [sensor.name for sensor in sensors if self.count_publishers(sensor.topic)]

    def _on_idle_timer(self) -> None:
        """When nothing comes any more, what was held back for others is used all the same."""
        if time.monotonic() - self._silence.last_s > _IDLE_S:
            self._worker.post(self._pipeline.flush)

    # --- diagnostics -------------------------------------------------------------------------

    def _report(self) -> Report:
        for misfit in self._topics.misfits() if self._topics is not None else ():
            self._troubles.complain(misfit)
        values: dict[str, float | int | str] = {
            **dict(sorted((self._troubles.counts + self._outputs.counts).items())),
            "num_bad": self._troubles.counts["num_bad"],
            "num_waiting": self._worker.num_waiting,
            **self._pipeline.values(),
        }
        silence: tuple[Severity, str] = ("info", "")
        if not self._pipeline.is_finished:
            silence = self._silence.judge(time.monotonic())
        return self._troubles.report(
            values, silence, self._pipeline.convention, is_paused=self._pipeline.is_paused
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Map until stopped."""
    return run_node("sonar_mapper", SonarMapper, argv)
