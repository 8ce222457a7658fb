"""Bags to a settled map queue, in this process and without DDS: the core of ``offline``."""

from __future__ import annotations

import dataclasses
import itertools
import math
import multiprocessing
import statistics
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.common import num_processors, num_workers
from uw_dslam_ros2.cli.running.examining import (
    ExaminedVehicle,
    can_be_mapped,
    examine_vehicle,
    mountings_of,
    together,
)
from uw_dslam_ros2.core.chart.pings import DrawnPing, KeptPings
from uw_dslam_ros2.core.clocks import find_gaps, gaps_at_the_ends
from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.health import MappedVehicle, SensorCount, health_findings
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.runs import RunBreak, VehicleRuns
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, MatchRequest
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.bags import ImuEvent, TransformEvent, TruthEvent
from uw_dslam_ros2.io.conventions import CorrectedMountings
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.examining import mended
from uw_dslam_ros2.io.feeding import feed_runs, in_stamp_order
from uw_dslam_ros2.io.heap import trim
from uw_dslam_ros2.io.mountings import role_of
from uw_dslam_ros2.io.readings import DepthEvent, FixEvent, VelocityEvent
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.io.vehicles import VehicleRecording

__all__ = [
    "OfflineConfig",
    "VehicleSubmaps",
    "map_recording",
    "map_recordings",
    "sensor_config",
    "settle",
]

# One number, whatever the machine: which registrations are asked next depends on the answers.
_BATCH = 4
_YAW_WAIT_S = 1.0  # as long as the navigation filter waits for a heading

Counter = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class OfflineConfig:
    """Settings of all parts; each vehicle may have its own."""

    mapper: dict[str, VehicleMapperConfig]
    registration: GridRegistrationConfig
    queue: MapQueueConfig
    sensors: dict[str, SensorConfig]

    @classmethod
    def read(cls, path: str | Path | None, vehicles: Sequence[str]) -> OfflineConfig:
        """Take from a settings file what the nodes of these vehicles would take from it."""
        file = SettingsFile(path)
        return cls(
            {
                name: file.section(VehicleMapperConfig, "mapper", f"/{name}/sonar_mapper")
                for name in vehicles
            },
            file.section(GridRegistrationConfig, "registration", "/registration_server"),
            file.section(MapQueueConfig, "queue", "/map_queue_manager"),
            {name: sensor_config(file, name) for name in vehicles},
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "mapper": {name: config.to_dict() for name, config in self.mapper.items()},
            "sensors": {name: config.to_dict() for name, config in self.sensors.items()},
            "registration": self.registration.to_dict(),
            "queue": self.queue.to_dict(),
        }


def sensor_config(file: SettingsFile, vehicle_id: str) -> SensorConfig:
    """What a settings file says of one vehicle's sensors."""
    return file.plain(SensorConfig, f"/{vehicle_id}/sonar_mapper")


@dataclass(frozen=True, slots=True, eq=False)
class VehicleSubmaps:
    """What one vehicle's recording became."""

    vehicle_id: str
    submaps: tuple[Submap, ...]
    diagnostics: dict[str, float | int | str]
    findings: tuple[Finding, ...] = ()
    pings: Mapping[SubmapId, Sequence[DrawnPing]] = field(default_factory=dict)
    fixes: tuple[FixEvent, ...] = ()
    """Positions on earth that it was told, in order of time; nothing of the map is made of them.
    """
    depth_m: float = math.nan
    """Median of its depths, NaN where it has none."""


def map_recordings(
    recordings: Sequence[VehicleRecording],
    config: OfflineConfig,
    progress: Counter | None = None,
) -> list[VehicleSubmaps]:
    """Map every vehicle by itself, several at a time; the result does not depend on how many."""
    context = multiprocessing.get_context("spawn")
    done = context.Value("q", 0)
    total = sum(recording.num_messages for recording in recordings)
    num_processes = num_workers(len(recordings))
    with ProcessPoolExecutor(
        num_processes, mp_context=context, initializer=_share, initargs=(done,)
    ) as pool:
        own = [(r, config.mapper[r.vehicle_id], config.sensors[r.vehicle_id]) for r in recordings]
        count = (lambda: progress(done.value, total)) if progress is not None else None
        try:
            mappable = [r.vehicle_id for r in recordings if can_be_mapped(r)]
            looks = [
                pool.submit(examine_vehicle, recording, sensors, mapper.sonar)
                for recording, mapper, sensors in own
                if recording.vehicle_id in mappable
            ]
            found = dict(zip(mappable, together(_results(looks, count)), strict=True))
            futures = [
                pool.submit(map_recording, *of_one, found.get(of_one[0].vehicle_id))
                for of_one in own
            ]
            return _results(futures, count)
        except BrokenProcessPool as error:
            raise DataError(
                "a mapping process was ended from outside; is there enough memory for "
                f"{num_processes} vehicles at a time?"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _results[T](futures: Sequence[Future[T]], count: Callable[[], None] | None) -> list[T]:
    """Of all futures in their order, or the first error as soon as it is raised."""
    while wait(futures, timeout=0.2).not_done:
        if count is not None:
            count()
        for future in futures:
            if future.done():
                future.result()
    return [future.result() for future in futures]


_shared: list[Synchronized[int]] = []


def _share(done: Synchronized[int]) -> None:
    _shared.append(done)


def _count(number: int) -> None:
    for done in _shared:
        with done.get_lock():
            done.value += number


def map_recording(
    recording: VehicleRecording,
    config: VehicleMapperConfig,
    sensors: SensorConfig = SensorConfig(),  # noqa: B008 (frozen)
    examined: ExaminedVehicle | None = None,
) -> VehicleSubmaps:
    """Map one vehicle; `DataError` where its bags cannot be read or a mounting is not known.

    A recording without a sonar, or without any heading, makes no map, and findings that say so.
    `examined` is what was found of it (default: it is examined first, by itself).
    """
    if not can_be_mapped(recording):
        present = {role: SensorCount(1) for role in recording.topics}
        found = health_findings(MappedVehicle(recording.vehicle_id, present, {}))
        return VehicleSubmaps(recording.vehicle_id, (), {}, tuple(found))
    if examined is None:
        examined = examine_vehicle(recording, sensors, config.sonar)
    run_ids, kept = itertools.count(1), KeptPings()
    newest: dict[SubmapId, Submap] = {}
    fixes: list[FixEvent] = []
    depths_m: list[float] = []
    locked_ns: list[int] = []
    number = 0
    has_yaw = has_yaw_rate = False
    first_ns: int | None = None
    with VehicleReader(recording, sensors) as reader:
        reader.stamps = dict(examined.stamps)
        mountings = mountings_of(recording, sensors, reader.transforms())
        reader.conventions, sonar, said = mended(
            examined.examination, sensors.conventions, config.sonar
        )
        findings = [*examined.about_clocks, *said]
        config = dataclasses.replace(config, sonar=sonar)
        corrected = CorrectedMountings(reader.conventions)
        runs = VehicleRuns(config, recording.vehicle_id, lambda: next(run_ids), kept)
        for number, event in enumerate(in_stamp_order(reader.events()), start=1):
            if number % 200 == 0:
                _count(200)
            if isinstance(event, TruthEvent | TransformEvent):
                continue
            if isinstance(event, FixEvent):
                fixes.append(event)
                continue
            if isinstance(event, DepthEvent) and math.isfinite(event.depth_m):
                depths_m.append(event.depth_m)
            if isinstance(event, VelocityEvent) and np.isfinite(event.velocity_m_s).all():
                locked_ns.append(event.stamp_ns)
            first_ns = event.stamp_ns if first_ns is None else first_ns
            if isinstance(event, ImuEvent):
                late_s = (event.stamp_ns - first_ns) * 1e-9
                if not has_yaw and event.yaw_rad is not None and late_s > _YAW_WAIT_S:
                    findings.append(_late_heading(late_s))
                has_yaw |= event.yaw_rad is not None
                has_yaw_rate |= event.yaw_rate_rad_s is not None
            try:
                mounting = corrected.of(event, mountings.of(event))
                if mounting is None:
                    continue
                submaps = feed_runs(runs, event, mounting)
            except InvalidInputError as error:
                raise DataError(f"{recording.vehicle_id}: {role_of(event)}: {error}") from error
            newest |= {submap.submap_id: submap for submap in submaps}
        newest |= {submap.submap_id: submap for submap in runs.finish()}
    _count(number % 200)
    findings += [_new_run(reason) for reason in runs.breaks]
    diagnostics = runs.diagnostics()
    stamps_ns, poses = runs.trajectory()
    sensor_stamps = {r: stamps[stamps > 0] for r, stamps in reader.stamps.items()}
    sensor_stamps = {role: stamps for role, stamps in sensor_stamps.items() if len(stamps)}
    gaps = find_gaps(sensor_stamps)
    if "sonar" in sensor_stamps:
        locked = np.array(locked_ns, np.int64)
        gaps += gaps_at_the_ends(sensor_stamps["sonar"], "velocity", locked)
    vehicle = MappedVehicle(
        recording.vehicle_id,
        {
            role: SensorCount(
                count.num - count.num_repeated,
                count.num_bad,
                count.num_empty,
                count.problem,
                count.num_early,
            )
            for role, count in reader.counts.items()
            if count.num and role != "truth"
        },
        diagnostics,
        tuple(dict.fromkeys(gaps)),
        {role: (int(s.min()), int(s.max())) for role, s in sensor_stamps.items()},
        stamps_ns,
        poses,
        has_yaw=has_yaw,
        has_yaw_rate=has_yaw_rate,
        is_yaw_left_out=reader.conventions.imu_orientation == "none",
    )
    findings = [
        dataclasses.replace(finding, vehicle_id=recording.vehicle_id)
        for finding in (*findings, *reader.findings)
    ]
    return VehicleSubmaps(
        recording.vehicle_id,
        tuple(newest[key] for key in sorted(newest)),
        diagnostics,
        (
            *findings,
            *mountings.findings(recording.vehicle_id),
            *health_findings(vehicle),
        ),
        kept.of_submap,
        tuple(fixes),
        statistics.median(depths_m) if depths_m else math.nan,
    )


def _new_run(reason: RunBreak) -> Finding:
    what = "heading" if reason.role == "imu" else "velocity of the vehicle, which moves,"
    return Finding(
        "new_run",
        reason.role,
        f"its {what} is missing for {reason.seconds:.0f} s; what is mapped after that is a map of "
        "its own, which only registration joins to the one before",
    )


def _late_heading(late_s: float) -> Finding:
    return Finding(
        "late_heading",
        "imu",
        f"its first orientation comes {late_s:.1f} s after the recording begins, so that the map "
        "begins with a heading that is guessed; cut that part off, or wait for the imu",
    )


def settle(
    queue: MapQueue, config: GridRegistrationConfig, progress: Counter | None = None
) -> None:
    """Answer all that a queue asks, until it asks no more.

    No clock is given to the registration: its only budget is the number of boxes, so that the
    answers do not depend on the machine.
    """

    def answer(request: MatchRequest) -> RegistrationResult:
        result = register_grids(request.source, request.target, config, prior=request.prior)
        trim()  # or the next one, of maps of other sizes, finds no room in the holes
        return result

    with ThreadPoolExecutor(num_processors()) as pool:
        while requests := queue.next_requests(_BATCH):
            futures = [pool.submit(answer, request) for request in requests]
            for request, future in zip(requests, futures, strict=True):
                queue.add_result(request.request_id, future.result())
                if progress is not None:
                    progress(
                        queue.num_registrations, queue.num_registrations + queue.num_in_flight
                    )
