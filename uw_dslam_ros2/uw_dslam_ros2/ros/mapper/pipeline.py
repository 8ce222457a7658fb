"""From sensors' events to submaps: put in order, mounted, mapped, kept, given away."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mapping import RunBreak, VehicleMapper, VehicleMapperConfig, VehicleRuns
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap
from uw_dslam_ros2.io.conventions import CorrectedMountings
from uw_dslam_ros2.io.feeding import SensorEvent, feed_runs
from uw_dslam_ros2.io.heap import trim
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.io.readings import PINGS, TransformEvent
from uw_dslam_ros2.ros.mapper.convention_watch import ConventionWatch
from uw_dslam_ros2.ros.mapper.last_pass import LastPass
from uw_dslam_ros2.ros.mapper.outputs import MapperOutputs
from uw_dslam_ros2.ros.mapper.run_keeper import RunKeeper
from uw_dslam_ros2.ros.mapper.stamp_order import StampOrder
from uw_dslam_ros2.ros.mapper.troubles import MapperTroubles
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.throttle import Throttle

__all__ = ["MapperPipeline"]

_JUMP_BACK_S = 1.0  # stamps that go back by more are late, or show a clock that was set
_MANY_DISPLACED = 50
_MOUNT_PATIENCE_NS = 5_000_000_000
_ODOM_PERIOD_NS = 100_000_000
_KEEP_PERIOD_NS = 1_000_000_000


class MapperPipeline:
    """Drives the `VehicleRuns` of a mapper; all methods but `pause` in one thread, the worker's.

    Parameters
    ----------
    vehicle_id, base_frame
        Whose, and its body.
    outputs
        Where all goes.
    troubles
        Told of what cannot be used.
    warn
        Told what a person should know.
    streams_sent
        Names of the sensors that somebody sends now.
    """

    def __init__(
        self,
        config: SonarMapperConfig,
        mapper_config: VehicleMapperConfig,
        vehicle_id: str,
        base_frame: str,
        outputs: MapperOutputs,
        troubles: MapperTroubles,
        warn: Callable[[str], None],
        streams_sent: Callable[[], Iterable[str]],
    ) -> None:
        self._vehicle_id, self._outputs, self._troubles = vehicle_id, outputs, troubles
        self._warn, self._streams_sent = warn, streams_sent
        self._map_period_s = config.map_period_s
        occupancy = mapper_config.occupancy
        self._keeper = RunKeeper(config.session, vehicle_id, mapper_config, troubles.complain)
        self._last_pass = LastPass(occupancy, warn)
        self._runs = VehicleRuns(mapper_config, vehicle_id, _draw_run_id, self._last_pass.pings)
        self._order: StampOrder[SensorEvent] = StampOrder(
            int(_reorder_s(config) * 1e9),
            int(_JUMP_BACK_S * 1e9),
            int(mapper_config.max_gap_s * 1e9),
        )
        self._max_gap_s = mapper_config.max_gap_s
        self._resumed_ns: int | None = None
        self._mountings = Mountings(base_frame)
        self._corrected = CorrectedMountings(config.conventions)
        self._watch = ConventionWatch(
            mapper_config.sonar, vehicle_id, troubles.note_convention, troubles.complain_of
        )
        self._drawing = Throttle(config.map_period_s)
        self._odom_stamp_ns = self._map_stamp_ns = self._kept_ns = 0
        self._mapper_values: dict[str, float | int | str] = {}
        self.is_finished = self.is_paused = False

    def close(self) -> None:
        """End its threads, and let another process have the folder of its session."""
        self._watch.close()
        self._keeper.close()

    def set_map_period(self, period_s: float) -> None:
        """From the next map on."""
        self._map_period_s, self._drawing = period_s, Throttle(period_s)

    @property
    def convention(self) -> str:
        """What a sensor does not follow; empty: nothing is known."""
        return self._watch.sentence

    def values(self) -> dict[str, float | int | str]:
        """What the diagnostics say of it in numbers."""
        return {
            "num_frames": self._mountings.num_frames,
            "num_late": self._order.num_late,
            "num_pings_not_kept": self._last_pass.pings.num_left_out,
            **self._mapper_values,
        }

    @property
    def _mapper(self) -> VehicleMapper:
        """Of the run that goes on."""
        return self._runs.mapper

    # --- events ------------------------------------------------------------------------------

    def take(self, stream: str, stamp_ns: int, event: SensorEvent | None) -> None:
        """Put an event in line; None only says how far the stream has come."""
        if self._order.newest_ns is None:
            self._expect_streams(stamp_ns)
        if self._order.offer(stream, stamp_ns, event):
            self._begin_anew(stream, stamp_ns)
        if self.is_finished:
            self._troubles.complain(
                f"mapping was finished; messages on {stream} are left out until ~/reset begins a "
                "new run"
            )
            return
        if self._order.displaced.get(stream, 0) > _MANY_DISPLACED:
            self._troubles.complain(
                f"the stamps of {stream} have jumped, and those of other sensors have not: its "
                "messages are left out; are the clocks of both computers set?"
            )
        self._drain()

    def _expect_streams(self, stamp_ns: int) -> None:
        """At the start, wait for the first message of every sensor that somebody sends."""
        for stream in self._streams_sent():
            self._order.expect(stream, stamp_ns - 1)  # its own may be of the same moment

    def _begin_anew(self, stream: str, stamp_ns: int) -> None:
        """The clock was set, or a recording began again: what was mapped is kept as a run."""
        newest_ns = self._order.newest_ns or stamp_ns
        for event in self._order.rest():
            self._feed(event)
        self._order.begin_anew()
        way = "back" if stamp_ns < newest_ns else "ahead"
        self._warn(
            f"the clock went {way} by {abs(stamp_ns - newest_ns) * 1e-9:.1f} s (on {stream}): a "
            "new run begins; what was mapped before is kept, and only registration joins the two"
        )
        self._begin_run(RunBreak("", newest_ns, stamp_ns))

    def _begin_run(self, reason: RunBreak) -> None:
        self._give(self._runs.begin(reason))
        self._keeper.forget_open()
        self._odom_stamp_ns = self._map_stamp_ns = self._kept_ns = 0
        self.is_finished = False
        self._troubles.counts["num_restarts"] += 1

    def resume(self) -> None:
        """Take over the run of the process before, where there is one; before any event."""
        run = self._keeper.resume()
        if run is None:
            return
        try:
            self._runs.resume(run.state, run.held)
        except InvalidInputError as error:
            self._troubles.complain(f"the run of before cannot be gone on with: {error}")
            return
        self._keeper.take(run)
        self._last_pass.pings.take(run.pings)
        self._resumed_ns = self._mapper.stamp_ns

    def _go_on(self, last_ns: int, stamp_ns: int) -> None:
        """Go on with the run of before, or end it where the way since then is not known."""
        gap_s = (stamp_ns - last_ns) * 1e-9
        if -_JUMP_BACK_S <= gap_s <= self._max_gap_s:
            self._warn(f"the run of before is gone on with, {gap_s:.1f} s after its last message")
            return
        way = "after" if gap_s > 0.0 else "before"
        self._warn(
            f"the first message is {abs(gap_s):.0f} s {way} the last one of the run of before: a "
            "new run begins; what was mapped before is kept, and only registration joins the two"
        )
        self._begin_run(RunBreak("", last_ns, stamp_ns))

    def flush(self) -> None:
        """Use all that was held back for others; nothing earlier is expected any more."""
        for event in self._order.rest():
            self._feed(event)
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is not None and stamp_ns > self._map_stamp_ns:
            self._publish_map(stamp_ns)
        if stamp_ns is not None and stamp_ns > self._kept_ns:
            self._keep_open(stamp_ns)

    def _drain(self) -> None:
        """Feed what is due, in the order of the stamps."""
        while (event := self._order.peek()) is not None:
            newest_ns = self._order.newest_ns or event.stamp_ns
            is_patient = newest_ns - event.stamp_ns < _MOUNT_PATIENCE_NS
            if is_patient and not self._mountings.is_known(event):
                return  # /tf_static is on its way
            self._feed(self._order.pop())

    def mount(self, event: TransformEvent) -> None:
        """Take a transform, and go on with what waited for it."""
        self._mountings.add(event)
        self._drain()

    def _feed(self, event: SensorEvent) -> None:
        if self._resumed_ns is not None:
            last_ns, self._resumed_ns = self._resumed_ns, None
            self._go_on(last_ns, event.stamp_ns)
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
            self._odom_stamp_ns = self._map_stamp_ns = self._kept_ns = 0
        stamp_ns = self._mapper.stamp_ns
        if stamp_ns is None:
            return
        if stamp_ns - self._odom_stamp_ns >= _ODOM_PERIOD_NS:
            self._odom_stamp_ns = stamp_ns
            self._outputs.publish_odometry(self._mapper, stamp_ns)
        if isinstance(event, PINGS):
            self._mapper_values = self._runs.diagnostics()
            if stamp_ns - self._kept_ns >= _KEEP_PERIOD_NS:
                self._keep_open(stamp_ns)
            is_old = stamp_ns - self._map_stamp_ns >= self._map_period_s * 1e9
            if is_old and self._drawing.is_due():
                self._publish_map(stamp_ns)

    def _keep_open(self, stamp_ns: int) -> None:
        self._kept_ns = stamp_ns
        self._keeper.keep_open(self._mapper, self._last_pass.pings.of_submap)

    def _publish_map(self, stamp_ns: int) -> None:
        self._map_stamp_ns = stamp_ns
        with self._drawing.turn():
            self._outputs.publish_map(self._mapper, stamp_ns)

    # --- what the services ask for -----------------------------------------------------------

    def pause(self, is_paused: bool) -> str:
        """Leave out the pings that come from now on; navigation, and so the run, goes on."""
        self.is_paused = is_paused
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
        if self.is_finished:
            return "finished before; nothing changes"
        self.flush()
        before = self._mapper.trajectory()[1]
        self.close_last()
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

    def close_last(self) -> None:
        """Close the last submap; nothing is mapped after that."""
        self.flush()
        self._give(self._runs.finish())
        self.is_finished = True

    def _give(self, submaps: list[Submap]) -> None:
        """Give submaps away; a process that is killed in between has kept them."""
        self._keeper.keep(submaps, self._last_pass.pings.of_submap)
        self._outputs.publish_submaps(submaps)
        if submaps:
            trim()  # to look for loops takes a hundred megabytes for a moment


def _reorder_s(config: SonarMapperConfig) -> float:
    """Live, a sensor that died must not hold up the others for long; in a replay it may."""
    live_s, replay_s = 1.0, 60.0
    return config.reorder_s or (replay_s if config.is_reliable else live_s)


def _draw_run_id() -> int:
    """Different also for two mappers that start in the same moment."""
    return 1 + secrets.randbelow(MAX_RUN_ID)
