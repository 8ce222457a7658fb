"""What happened to the vehicles, in order: the messages of bags as plain core values."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from uw_dslam_ros2.core.clocks import StreamTimes, corrected_clocks
from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io import messages
from uw_dslam_ros2.io.conventions import correct
from uw_dslam_ros2.io.drivers import ADAPTERS, ReadSettings
from uw_dslam_ros2.io.frozen import FrozenSensors
from uw_dslam_ros2.io.readings import (
    DepthEvent,
    Event,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    ScanEvent,
    TransformEvent,
    TruthEvent,
    VelocityEvent,
)
from uw_dslam_ros2.io.recordings import BagReader, RawMessage, merged, open_bag
from uw_dslam_ros2.io.sensor_settings import SensorConfig, TopicsConfig
from uw_dslam_ros2.io.topics import roles_of_type
from uw_dslam_ros2.io.vehicles import VehicleRecording, find_recordings

__all__ = [
    "DepthEvent",
    "Event",
    "ImageEvent",
    "ImuEvent",
    "MessageCount",
    "PointsEvent",
    "ScanEvent",
    "TransformEvent",
    "TruthEvent",
    "VehicleReader",
    "VelocityEvent",
    "read_events",
    "readings_of",
]

_SECOND_NS = 1_000_000_000
_MAX_MOUNTINGS = 200
"""Messages of /tf that are read for mountings: it goes on at a high rate, and repeats them."""
_NUM_LOOKS, _MOUNTINGS_A_LOOK = 20, 40
"""Times at which it is looked at again, for mountings that move."""
_RECENT = 4
"""Messages of a sensor that may be recorded again, by another recorder."""
_TRUTH = "truth"


def read_events(
    paths: str | Path | Sequence[str | Path],
    vehicle_id: str | None = None,
    data_order: str = "auto",
    *,
    topics: TopicsConfig | None = None,
    water_density_kg_m3: float = 1025.0,
) -> Iterator[Event]:
    """Events of one or several bags, fixed transforms first.

    Those of each vehicle in order of recording, vehicles merged by the stamps.

    Parameters
    ----------
    paths : bags, as `open_bag` takes them.
    vehicle_id : whose they are; None takes it from the topics' namespace (``/auv_1/sonar``).
    data_order : layout of sonar images, "auto", "range_major" or "beam_major".
    topics : topics that are set; the others are found by their types.
    water_density_kg_m3 : turns pressure into depth; fresh water has 1000.

    Yields
    ------
    Event
        ``stamp_ns`` is the header's time. Messages that carry no information (a DVL without bottom
        lock) yield none.

    Raises
    ------
    DataError
        If a bag is unusable, no topic can be read, or a message is malformed.
    """
    settings = SensorConfig(
        data_order=data_order,
        water_density_kg_m3=water_density_kg_m3,
        topics=topics or TopicsConfig(),
    )
    paths = [paths] if isinstance(paths, str | Path) else list(paths)
    if not paths:
        raise DataError("no bags given; expected at least one path")
    named = {} if vehicle_id is None else {vehicle_id: paths}
    recordings, _ = find_recordings([] if named else paths, lambda _: settings, named)
    with ExitStack() as stack:
        readers = [
            stack.enter_context(VehicleReader(recording, settings, is_strict=True))
            for recording in recordings
        ]
        for reader in readers:
            yield from reader.transforms()
        yield from heapq.merge(
            *(reader.events() for reader in readers), key=lambda event: event.stamp_ns
        )


@dataclass(slots=True)
class MessageCount:
    """What became of a sensor's messages; `problem` is that of the first bad one.

    `num_read` are those of `num` that were wanted; `num_early` those of `num_empty` that came
    before the first one that said something.
    """

    num: int = 0
    num_read: int = 0
    num_bad: int = 0
    num_empty: int = 0
    num_early: int = 0
    has_said: bool = False
    num_repeated: int = 0
    problem: str = ""


class VehicleReader:
    """One vehicle's messages as events; a context manager.

    Stamps are on one clock, as `corrected_clocks` leaves them, unless `is_strict`: then stamps are
    as they are, and the first bad message raises.

    Parameters
    ----------
    recording : whose, from which bags and topics.
    settings : what messages do not say of themselves.
    is_strict : raise `DataError` for a bad message; else count it and go on.
    """

    def __init__(
        self,
        recording: VehicleRecording,
        settings: SensorConfig = SensorConfig(),  # noqa: B008 (frozen)
        *,
        is_strict: bool = False,
    ) -> None:
        self._recording = recording
        self._is_strict = is_strict
        self.conventions = settings.conventions
        self._roles = {topic: role for role, topic in recording.topics.items()}
        self._readers: list[BagReader] = []
        self._stack = ExitStack()
        self.findings: list[Finding] = []
        self._read_settings = {
            role: settings.read_settings(recording.vehicle_id, role, self.findings.append)
            for role in recording.topics
        }
        self.counts: dict[str, MessageCount] = {role: MessageCount() for role in recording.topics}
        self.stamps: dict[str, np.ndarray[Any, np.dtype[np.int64]]] = {}

    def __enter__(self) -> Self:
        for bag in self._recording.bags:
            self._readers.append(self._stack.enter_context(open_bag(bag)))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def check_clocks(self) -> list[Finding]:
        """Read the stamps of all messages, to put them on one clock in `events`."""
        stamps: dict[str, list[int]] = {role: [] for role in self._recording.topics}
        recorded: dict[str, list[int]] = {role: [] for role in self._recording.topics}
        for index, raw in merged(self._readers, self._sensor_topics()):
            role = self._roles[raw.topic]
            stamps[role].append(_stamp_of(self._readers[index], raw))
            recorded[role].append(raw.stamp_ns)
        times = {
            role: StreamTimes(np.array(stamps[role], np.int64), np.array(recorded[role], np.int64))
            for role in stamps
            if role != _TRUTH
        }
        self.stamps, findings = corrected_clocks(times)
        return findings

    def transforms(self) -> Iterator[TransformEvent]:
        """Fixed transforms of all bags: those that are latched, then what /tf has beside them."""
        for is_latched in (True, False):
            for reader in self._readers:
                topics = [
                    topic
                    for topic, msgtype in reader.topics.items()
                    if roles_of_type(msgtype) == ("tf_static",)
                    and topic.endswith("tf_static") is is_latched
                    and self._is_mine(topic)
                ]
                for raw in _transforms_in(reader, topics, is_latched=is_latched):
                    yield from _transforms_of(reader.deserialize(raw), self._recording.vehicle_id)

    def _is_mine(self, topic: str) -> bool:
        """Whether a topic of transforms is everybody's, or below the vehicle's namespace."""
        namespace = topic.strip("/").rpartition("/")[0]
        own = self._recording.namespace
        return not namespace or not own or f"{own}/".startswith(f"{namespace}/")

    def events(
        self, is_wanted: Callable[[str, int | None], bool] | None = None
    ) -> Iterator[Event]:
        """Everything but transforms, in order of recording, in the usual conventions.

        `is_wanted` is asked with the role and the stamp (None where clocks were not checked) of
        each message before it is read.
        """
        number = dict.fromkeys(self._recording.topics, 0)
        last = {role: deque[bytes](maxlen=_RECENT) for role in self._recording.topics}
        frozen = FrozenSensors()
        for index, raw in merged(self._readers, self._sensor_topics()):
            role = self._roles[raw.topic]
            count = self.counts[role]
            count.num += 1
            position = number[role]
            number[role] += 1
            if raw.data in last[role] and _stamp_of(self._readers[index], raw) > 0:
                count.num_repeated += 1  # a message that was recorded twice says nothing new
                continue
            last[role].append(raw.data)
            stamp_ns = int(self.stamps[role][position]) if role in self.stamps else None
            if is_wanted is not None and not is_wanted(role, stamp_ns):
                continue
            count.num_read += 1
            try:
                found = self._read(self._readers[index], raw, role, stamp_ns)
            except (InvalidInputError, DataError, ValueError, TypeError, OverflowError) as error:
                text = f"bad message on {raw.topic} at {raw.stamp_ns} ns: {error}"
                if self._is_strict:
                    raise DataError(f"{self._readers[index].path}: {text}") from error
                count.num_bad += 1
                count.problem = count.problem or text
                continue
            if not self._is_strict and frozen.is_frozen(found):
                continue
            usual = [correct(event, self.conventions) for event in found]
            kept = [event for event in usual if event is not None]
            count.num_empty += not kept
            if kept and not count.has_said:
                count.has_said, count.num_early = True, count.num_empty
            yield from kept
        self.findings += frozen.findings()

    def _read(
        self, reader: BagReader, raw: RawMessage, role: str, stamp_ns: int | None
    ) -> Sequence[Event]:
        msg = reader.deserialize(raw)
        if stamp_ns is not None:
            if stamp_ns <= 0:
                raise InvalidInputError("header.stamp is 0, expected the time of the measurement")
            if hasattr(msg, "header"):
                stamp = msg.header.stamp
                stamp.sec, stamp.nanosec = divmod(stamp_ns, _SECOND_NS)
        found = readings_of(raw.msgtype, msg, self._read_settings[role])
        if not hasattr(msg, "header"):
            time_ns = raw.stamp_ns if stamp_ns is None else stamp_ns
            found = [dataclasses.replace(event, stamp_ns=time_ns) for event in found]
        return found

    def _sensor_topics(self) -> list[list[str]]:
        return [[t for t in self._roles if t in reader.topics] for reader in self._readers]


def _stamp_of(reader: BagReader, raw: RawMessage) -> int:
    """Time of a message's header without reading the rest; the time of recording without one."""
    if not reader.has_header(raw.msgtype) or len(raw.data) < 12:
        return raw.stamp_ns
    order = "<" if raw.data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw.data, 4)
    return int(seconds) * _SECOND_NS + int(nanoseconds)


def _transforms_in(
    reader: BagReader, topics: Sequence[str], *, is_latched: bool
) -> Iterator[RawMessage]:
    """Messages with mountings: all that are latched, of others the first and some of later."""
    if not topics:
        return
    if is_latched:
        yield from reader.raw(topics)
        return
    starts_ns = np.linspace(reader.start_ns, reader.end_ns, _NUM_LOOKS + 1, dtype=np.int64)[:-1]
    seen_ns = reader.start_ns - 1
    for start_ns in starts_ns.tolist():
        most = _MAX_MOUNTINGS if start_ns == reader.start_ns else _MOUNTINGS_A_LOOK
        for raw in itertools.islice(reader.raw(topics, max(start_ns, seen_ns + 1)), most):
            seen_ns = raw.stamp_ns
            yield raw


def _transforms_of(msg: Any, vehicle_id: str) -> Iterator[TransformEvent]:
    for item in msg.transforms:
        yield TransformEvent(
            vehicle_id,
            int(item.header.stamp.sec) * _SECOND_NS + int(item.header.stamp.nanosec),
            str(item.header.frame_id),
            str(item.child_frame_id),
            messages.matrix_of_transform(item.transform),
        )


# --- messages to readings
# -----------------------------------------------------------------------------------------------


def readings_of(msgtype: str, msg: Any, settings: ReadSettings) -> Sequence[Event]:
    """What a message says in the role of `settings`; nothing where it holds nothing.

    Raises
    ------
    InvalidInputError
        Naming the field that is malformed.
    """
    if settings.role == _TRUTH:
        key = (settings.vehicle_id, messages.stamp_of(msg), str(msg.header.frame_id))
        return [TruthEvent(*key, messages.pose_of_odometry(msg))]
    return ADAPTERS[msgtype].read(msg, settings)
