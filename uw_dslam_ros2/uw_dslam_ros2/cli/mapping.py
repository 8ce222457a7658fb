"""Bags to a settled map queue, in this process and without DDS: the core of ``offline``."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.common import num_processors, num_workers
from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.vehicle_mapper import VehicleMapper
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, MatchRequest
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.bags import TransformEvent, TruthEvent, open_bag, read_events
from uw_dslam_ros2.io.feeding import Mountings, feed, in_stamp_order
from uw_dslam_ros2.io.settings import SettingsFile

__all__ = ["OfflineConfig", "VehicleSubmaps", "map_bag", "map_bags", "settle", "vehicle_of_bag"]

# One number, whatever the machine: which registrations are asked next depends on the answers.
_BATCH = 4

Counter = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class OfflineConfig:
    """Settings of all parts; each vehicle may have its own."""

    mapper: dict[str, VehicleMapperConfig]
    registration: GridRegistrationConfig
    queue: MapQueueConfig

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
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "mapper": {name: config.to_dict() for name, config in self.mapper.items()},
            "registration": self.registration.to_dict(),
            "queue": self.queue.to_dict(),
        }


@dataclass(frozen=True, slots=True, eq=False)
class VehicleSubmaps:
    """What one vehicle's recording became."""

    vehicle_id: str
    submaps: tuple[Submap, ...]
    diagnostics: dict[str, float | int | str]


def vehicle_of_bag(path: Path) -> str:
    """Name of the one vehicle of a bag, by the namespace of its topics.

    Raises
    ------
    DataError
        If there is none, or more than one.
    """
    with open_bag(path) as reader:
        names = {topic.strip("/").split("/")[0] for topic in reader.topics if topic.count("/") > 1}
    if len(names) != 1:
        raise DataError(
            f"{path}: its topics have the namespaces {', '.join(sorted(names)) or '(none)'}; "
            "expected those of one vehicle, as in /auv_1/sonar"
        )
    return names.pop()


def map_bags(
    bags: Sequence[Path], config: OfflineConfig, progress: Counter | None = None
) -> list[VehicleSubmaps]:
    """Map every vehicle by itself, several at a time; the result does not depend on how many."""
    context = multiprocessing.get_context("spawn")
    done = context.Value("q", 0)
    total = 0
    for bag in bags:
        with open_bag(bag) as reader:
            total += sum(reader.message_counts.values())
    num_processes = num_workers(len(bags))
    with ProcessPoolExecutor(
        num_processes, mp_context=context, initializer=_share, initargs=(done,)
    ) as pool:
        futures = []
        for bag in bags:
            vehicle_id = vehicle_of_bag(bag)
            futures.append(pool.submit(map_bag, bag, vehicle_id, config.mapper[vehicle_id]))
        try:
            while wait(futures, timeout=0.2).not_done:
                if progress is not None:
                    progress(done.value, total)
                _raise_early(futures)
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            raise DataError(
                "a mapping process was ended from outside; is there enough memory for "
                f"{num_processes} vehicles at a time?"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _raise_early(futures: list[Future[VehicleSubmaps]]) -> None:
    for future in futures:
        if future.done():
            future.result()


_shared: list[Synchronized[int]] = []


def _share(done: Synchronized[int]) -> None:
    _shared.append(done)


def _count(number: int) -> None:
    for done in _shared:
        with done.get_lock():
            done.value += number


def map_bag(bag: Path, vehicle_id: str, config: VehicleMapperConfig) -> VehicleSubmaps:
    """Map one vehicle's bag; `DataError` where it cannot be read."""
    mapper = VehicleMapper(config, vehicle_id)
    mountings = Mountings(f"{vehicle_id}/base_link")
    newest: dict[int, Submap] = {}
    number = 0
    for number, event in enumerate(in_stamp_order(read_events(bag)), start=1):
        if number % 200 == 0:
            _count(200)
        if isinstance(event, TransformEvent):
            mountings.add(event)
            continue
        if isinstance(event, TruthEvent):
            continue
        try:
            submaps = feed(mapper, event, mountings.of(event))
        except InvalidInputError as error:
            raise DataError(f"{bag}: {type(event).__name__}: {error}") from error
        newest |= {submap.sequence: submap for submap in submaps}
    newest |= {submap.sequence: submap for submap in mapper.finish()}
    _count(number % 200)
    return VehicleSubmaps(
        vehicle_id, tuple(newest[key] for key in sorted(newest)), mapper.diagnostics()
    )


def settle(
    queue: MapQueue, config: GridRegistrationConfig, progress: Counter | None = None
) -> None:
    """Answer all that a queue asks, until it asks no more.

    No clock is given to the registration: its only budget is the number of boxes, so that the
    answers do not depend on the machine.
    """

    def answer(request: MatchRequest) -> RegistrationResult:
        return register_grids(request.source, request.target, config, prior=request.prior)

    with ThreadPoolExecutor(num_processors()) as pool:
        while requests := queue.next_requests(_BATCH):
            futures = [pool.submit(answer, request) for request in requests]
            for request, future in zip(requests, futures, strict=True):
                queue.add_result(request.request_id, future.result())
                if progress is not None:
                    progress(
                        queue.num_registrations, queue.num_registrations + queue.num_in_flight
                    )
