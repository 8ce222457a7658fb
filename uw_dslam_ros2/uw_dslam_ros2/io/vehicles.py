"""Which bags are whose: recordings of vehicles in the bags that a user names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from uw_dslam_ros2.core.errors import ConfigError, DataError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.recordings import open_bag
from uw_dslam_ros2.io.sensor_settings import SENSOR_ROLES, SensorConfig
from uw_dslam_ros2.io.topics import VehicleTopics, find_vehicles, roles_of_type

__all__ = ["VehicleRecording", "find_recordings", "recordings_of"]

_MAX_PAUSE_NS = 30_000_000_000
"""A vehicle that was restarted sooner than this is where it was; later, it may be anywhere."""

_UNSTAMPED = {"std_msgs/msg"}
"""Packages whose messages have no stamp, so that two of different times may be alike."""


@dataclass(frozen=True, slots=True)
class VehicleRecording:
    """One vehicle's bags, in order of time, and which of their topics are read.

    Parameters
    ----------
    vehicle_id : its name.
    namespace : what its topics begin with, without slashes at the ends.
    topics : role -> topic, as in `VehicleTopics`.
    bags : at least one.
    num_messages : of those topics, in all bags.
    """

    vehicle_id: str
    namespace: str
    topics: dict[str, str]
    bags: tuple[Path, ...]
    num_messages: int = 0


@dataclass(frozen=True, slots=True)
class _Bag:
    """What a recording holds, without its messages."""

    path: Path
    topics: dict[str, str]
    counts: dict[str, int]
    start_ns: int
    end_ns: int
    damage: str

    @classmethod
    def of(cls, path: Path) -> _Bag:
        with open_bag(path) as reader:
            counts = {t: n for t, n in reader.message_counts.items() if n}
            # Mountings are latched: a recording begins with those of long ago.
            sensors = [
                t for t in counts if set(roles_of_type(reader.topics[t])) & set(SENSOR_ROLES)
            ]
            first = next(iter(reader.raw(sensors)), None) if sensors else None
            return cls(
                path,
                {topic: reader.topics[topic] for topic in counts},
                counts,
                reader.start_ns if first is None else first.stamp_ns,
                reader.end_ns,
                reader.damage,
            )

    @property
    def name(self) -> str:
        """The folder's or file's name."""
        return self.path.resolve().stem if self.path.is_file() else self.path.resolve().name


def find_recordings(
    paths: Sequence[str | Path],
    settings_of: Callable[[str], SensorConfig] = lambda _: SensorConfig(),
    named: Mapping[str, Sequence[str | Path]] | None = None,
) -> tuple[list[VehicleRecording], list[Finding]]:
    """Find the vehicles of bags, by the types and names of their topics.

    Parameters
    ----------
    paths : bags of any vehicles.
    settings_of : settings of a vehicle by its name: topics that are set, kinds of input.
    named : further bags, by the name of the vehicle that they are of.

    Returns
    -------
    tuple[list[VehicleRecording], list[Finding]]
        In order of the vehicles' names, with what deserves to be told: damaged bags, vehicles of
        one name, bags without a vehicle.

    Raises
    ------
    DataError
        If a bag cannot be opened, no vehicle is found, or a role is ambiguous (see
        `find_vehicles`).
    """
    files = [Path(path) for path in paths]
    seen = [file.resolve() for file in files]
    if twice := [file for file in files if seen.count(file.resolve()) > 1]:
        raise DataError(f"{twice[0]} is named twice; expected each bag once")
    bags = [_Bag.of(file) for file in files]
    findings: list[Finding] = []
    recordings = _recordings(bags, settings_of, findings)
    for name, own in (named or {}).items():
        own_bags = [_Bag.of(Path(path)) for path in own]
        bags += own_bags
        recordings.append(_named(name, own_bags, settings_of, findings))
    findings += [Finding("damaged_bag", "", f"{b.path}: {b.damage}") for b in bags if b.damage]
    ids = [recording.vehicle_id for recording in recordings]
    if twice_named := sorted({name for name in ids if ids.count(name) > 1}):
        raise DataError(f"two vehicles have the name {twice_named[0]}; name them by --vehicle")
    recordings.sort(key=lambda recording: recording.vehicle_id)
    return recordings, findings


def recordings_of(paths: Sequence[str | Path]) -> list[VehicleRecording]:
    """Vehicles of bags by their types and names alone."""
    return find_recordings(paths)[0]


def _recordings(
    bags: Sequence[_Bag],
    settings_of: Callable[[str], SensorConfig],
    findings: list[Finding],
) -> list[VehicleRecording]:
    if not bags:
        return []
    vehicles = find_vehicles([bag.topics for bag in bags], [bag.name for bag in bags], settings_of)
    mapped = [v for v in vehicles if set(v.topics) & {"sonar", "velocity", "imu", "odometry"}]
    if not mapped:
        names = sorted({topic for bag in bags for topic in bag.topics})
        raise DataError(
            f"{', '.join(str(bag.path) for bag in bags)}: none of the topics has a type that is "
            f"read ({', '.join(names)}); expected a sonar, a dvl and an imu"
        )
    used = {index for vehicle in mapped for index in vehicle.tables}
    findings += [
        Finding("no_vehicle", "", f"{bag.path} has no topic of a vehicle; it is left out")
        for index, bag in enumerate(bags)
        if index not in used and not _is_only_tf(bag)
    ]
    recordings = []
    taken = {vehicle.vehicle_id for vehicle in mapped}
    for vehicle in mapped:
        recordings += _by_time(vehicle, bags, taken, findings)
    return recordings


def _is_only_tf(bag: _Bag) -> bool:
    return all(roles_of_type(t) in ((), ("tf_static",)) for t in bag.topics.values())


def _named(
    name: str,
    bags: Sequence[_Bag],
    settings_of: Callable[[str], SensorConfig],
    findings: list[Finding],
) -> VehicleRecording:
    if not name or "/" in name:
        raise ConfigError(f"vehicle {name!r}: expected a name without slashes")
    found = _recordings(bags, lambda _: settings_of(name), findings)
    fitting = [r for r in found if r.vehicle_id == name] or found
    if len(fitting) != 1:
        raise DataError(
            f"{', '.join(str(bag.path) for bag in bags)} hold the vehicles "
            f"{', '.join(r.vehicle_id for r in fitting)}; expected one, for {name}"
        )
    return dataclasses.replace(fitting[0], vehicle_id=name)


def _by_time(
    vehicle: VehicleTopics,
    bags: Sequence[_Bag],
    taken: set[str],
    findings: list[Finding],
) -> list[VehicleRecording]:
    """One recording, or several, where bags of one name cannot be one vehicle's one dive."""
    groups: list[list[_Bag]] = []
    is_overlapping = is_pausing = False
    for bag in sorted((bags[i] for i in vehicle.tables), key=lambda b: (b.start_ns, b.name)):
        if not groups:
            groups.append([bag])
            continue
        sensors = set(vehicle.topics.values()) & set(bag.topics)
        end_ns = max(other.end_ns for other in groups[-1])
        is_same = any(sensors & set(b.topics) for b in groups[-1] if b.end_ns > bag.start_ns)
        if is_same and _repeats(bag, groups[-1], sensors):
            groups[-1].append(bag)
        elif is_same:
            is_overlapping = True
            groups.append([bag])
        elif bag.start_ns - end_ns > _MAX_PAUSE_NS:
            is_pausing = True
            groups.append([bag])
        else:
            groups[-1].append(bag)
    names = _names(vehicle.vehicle_id, groups, taken, by_bag=is_overlapping)
    if len(groups) > 1:
        why = "were recorded at the same time" if is_overlapping else "are more than 30 s apart"
        findings.append(
            Finding(
                "same_name" if is_overlapping else "paused",
                "",
                f"{len(groups)} recordings of {vehicle.vehicle_id} {why}: they are mapped as the "
                f"vehicles {', '.join(names)}"
                + ("; give each vehicle a name of its own" if not is_pausing else ""),
                vehicle_id="",
            )
        )
    return [
        VehicleRecording(
            name,
            vehicle.namespace,
            {r: t for r, t in vehicle.topics.items() if any(t in bag.topics for bag in group)},
            tuple(bag.path for bag in group),
            sum(bag.counts.get(t, 0) for bag in group for t in vehicle.topics.values()),
        )
        for name, group in zip(names, groups, strict=True)
    ]


def _repeats(bag: _Bag, earlier: Sequence[_Bag], topics: set[str]) -> bool:
    """Whether a bag's first message with a stamp is in an earlier one: two recorders ran."""
    stamped = sorted(t for t in topics if bag.topics[t].rpartition("/")[0] not in _UNSTAMPED)
    if not stamped:
        return False
    with open_bag(bag.path) as reader:
        first = next(iter(reader.raw(stamped)), None)
    for other in earlier:
        if first is None or first.topic not in other.topics:
            continue
        with open_bag(other.path) as reader:
            if any(raw.data == first.data for raw in reader.raw([first.topic])):
                return True
    return False


def _names(
    vehicle_id: str, groups: Sequence[Sequence[_Bag]], taken: set[str], *, by_bag: bool
) -> list[str]:
    if len(groups) == 1:
        return [vehicle_id]
    names = [group[0].name for group in groups]
    others = taken - {vehicle_id}
    if by_bag and len(set(names)) == len(names) and not others & set(names):
        return names
    return [vehicle_id, *(f"{vehicle_id}_{number}" for number in range(2, len(groups) + 1))]
