"""What happened to the vehicles, in order: the messages of bags as plain core values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.io import messages
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
from uw_dslam_ros2.io.recordings import BagReader, merged, open_bags

__all__ = [
    "TOPIC_TYPES",
    "DepthEvent",
    "Event",
    "ImageEvent",
    "ImuEvent",
    "PointsEvent",
    "ScanEvent",
    "TransformEvent",
    "TruthEvent",
    "VelocityEvent",
    "read_events",
]

_VELOCITY_TYPES = (
    "marine_acoustic_msgs/msg/Dvl",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
)
TOPIC_TYPES: dict[str, tuple[str, ...]] = {
    "sonar": ("marine_acoustic_msgs/msg/ProjectedSonarImage",),
    "imu": ("sensor_msgs/msg/Imu",),
    "dvl": _VELOCITY_TYPES,
    "velocity": _VELOCITY_TYPES,
    "depth": ("sensor_msgs/msg/FluidPressure",),
    "scan": ("sensor_msgs/msg/LaserScan",),
    "points": ("sensor_msgs/msg/PointCloud2",),
    "tf_static": ("tf2_msgs/msg/TFMessage",),
    "truth/odom": ("nav_msgs/msg/Odometry",),
}
"""Topics that are understood, by the name below the vehicle's namespace, and their types."""


def read_events(
    paths: str | Path | Sequence[str | Path],
    vehicle_id: str | None = None,
    data_order: str = "range_major",
    *,
    topics: Mapping[str, str] | None = None,
    water_density_kg_m3: float = 1025.0,
) -> Iterator[Event]:
    """Events of one or several bags in order of recording, fixed transforms first.

    Parameters
    ----------
    paths : bags, as `open_bag` takes them; with several, their messages are merged by time.
    vehicle_id : whose they are; None takes it from the topics' namespace (``/auv_1/sonar``).
    data_order : layout of sonar images, one of `messages.DATA_ORDERS`.
    topics : for bags with other names: a name of `TOPIC_TYPES` to the full topic in the bag.
    water_density_kg_m3 : turns pressure into depth; fresh water has 1000.

    Yields
    ------
    Event
        ``stamp_ns`` is the header's time. Messages that carry no information (a DVL without bottom
        lock) yield none.

    Raises
    ------
    DataError
        If a bag is unusable, a topic has the wrong type, no topic is known, or a message is
        malformed.
    """
    if data_order not in messages.DATA_ORDERS:
        raise DataError(f"data_order is {data_order!r}, expected one of {messages.DATA_ORDERS}")
    paths = [paths] if isinstance(paths, str | Path) else list(paths)
    context = _Context(vehicle_id, data_order, water_density_kg_m3)
    with open_bags(paths) as readers:
        roles = [_roles(reader, dict(topics or {})) for reader in readers]
        for is_static in (True, False):
            chosen = [
                [topic for topic, role in table.items() if (role == "tf_static") is is_static]
                for table in roles
            ]
            for index, raw in merged(readers, chosen):
                content = readers[index].deserialize(raw)
                try:
                    yield from context.convert(roles[index][raw.topic], raw.topic, content)
                except InvalidInputError as error:
                    raise DataError(
                        f"{readers[index].path}: bad message on {raw.topic} "
                        f"at {raw.stamp_ns} ns: {error}"
                    ) from error


def _roles(reader: BagReader, renamed: dict[str, str]) -> dict[str, str]:
    """Topic -> name in `TOPIC_TYPES`, of those topics of a bag that have one."""
    if unknown := sorted(set(renamed) - set(TOPIC_TYPES)):
        raise DataError(
            f"unknown topic role {unknown[0]!r}, expected one of {', '.join(TOPIC_TYPES)}"
        )
    by_topic = {topic: role for role, topic in renamed.items()}
    roles = {}
    for topic, msgtype in reader.topics.items():
        parts = topic.strip("/").split("/")
        names = ("/".join(parts[-2:]), parts[-1])
        role = by_topic.get(topic) or next((n for n in names if n in TOPIC_TYPES), None)
        if role is None or (role in renamed and topic not in by_topic):
            continue
        if msgtype not in TOPIC_TYPES[role]:
            raise DataError(
                f"{reader.path}: topic {topic} has type {msgtype}, "
                f"expected {' or '.join(TOPIC_TYPES[role])}"
            )
        roles[topic] = role
    if not roles:
        raise DataError(
            f"{reader.path}: none of its topics is known ({', '.join(sorted(reader.topics))}); "
            f"expected names that end in {', '.join(TOPIC_TYPES)}"
        )
    return roles


class _Context:
    """Turns messages into events."""

    def __init__(
        self, vehicle_id: str | None, data_order: str, water_density_kg_m3: float
    ) -> None:
        self._vehicle_id = vehicle_id
        self._data_order = data_order
        self._water_density_kg_m3 = water_density_kg_m3

    def convert(self, role: str, topic: str, msg: Any) -> Iterator[Event]:
        if role == "tf_static":
            yield from self._transforms(msg)
            return
        who = self._vehicle_id or _vehicle_of(topic, role)
        key = (who, messages.stamp_of(msg), str(msg.header.frame_id))
        event = self._CONVERTERS[role](self, key, msg)
        if event is not None:
            yield event

    def _transforms(self, msg: Any) -> Iterator[Event]:
        for item in msg.transforms:
            child = str(item.child_frame_id)
            yield TransformEvent(
                self._vehicle_id or child.strip("/").split("/")[0],
                int(item.header.stamp.sec) * 1_000_000_000 + int(item.header.stamp.nanosec),
                str(item.header.frame_id),
                child,
                messages.matrix_of_transform(item.transform),
            )

    def _image(self, key: _Key, msg: Any) -> Event:
        return ImageEvent(*key, messages.sonar_image_of(msg, self._data_order))

    def _imu(self, key: _Key, msg: Any) -> Event:
        return ImuEvent(*key, *messages.readings_of_imu(msg))

    def _velocity(self, key: _Key, msg: Any) -> Event | None:
        is_dvl = hasattr(msg, "velocity_mode")
        value = messages.velocity_of_dvl(msg) if is_dvl else messages.velocity_of_twist(msg)
        return None if value is None else VelocityEvent(*key, *value, is_z_down=is_dvl)

    def _depth(self, key: _Key, msg: Any) -> Event:
        return DepthEvent(*key, messages.depth_of_pressure(msg, self._water_density_kg_m3))

    def _scan(self, key: _Key, msg: Any) -> Event:
        return ScanEvent(*key, *messages.scan_of_laser_scan(msg))

    def _points(self, key: _Key, msg: Any) -> Event:
        return PointsEvent(*key, messages.points_of_cloud(msg))

    def _truth(self, key: _Key, msg: Any) -> Event:
        return TruthEvent(*key, messages.pose_of_odometry(msg))

    _CONVERTERS: Mapping[str, Callable[[_Context, _Key, Any], Event | None]] = {
        "sonar": _image,
        "imu": _imu,
        "dvl": _velocity,
        "velocity": _velocity,
        "depth": _depth,
        "scan": _scan,
        "points": _points,
        "truth/odom": _truth,
    }


_Key = tuple[str, int, str]
"""Vehicle, stamp [ns], frame: how every event begins."""


def _vehicle_of(topic: str, role: str) -> str:
    namespace = topic.strip("/").removesuffix(role).strip("/")
    if not namespace:
        raise InvalidInputError(
            f"topic {topic} has no namespace that names its vehicle; say whose it is (vehicle_id)"
        )
    return namespace.split("/")[0]
