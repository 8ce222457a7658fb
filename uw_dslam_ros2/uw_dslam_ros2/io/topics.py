"""Which topic plays which role, and whose it is: found by type, or as the settings say.

Pure functions on tables of topics (name -> type); nothing is opened here. A type says what a topic
can be; names only decide between several topics that can be the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.findings import WORDS
from uw_dslam_ros2.io.drivers import ADAPTERS
from uw_dslam_ros2.io.sensor_settings import SENSOR_ROLES as _SENSORS
from uw_dslam_ros2.io.sensor_settings import SensorConfig, TopicsConfig

__all__ = [
    "NAMES_OF_ROLES",
    "ROLES",
    "TopicsConfig",
    "VehicleTopics",
    "find_vehicles",
    "roles_of_type",
]

ROLES = ("sonar", "velocity", "imu", "depth", "odometry", "fix", "truth", "tf_static")
"""What a topic can be to a mapper."""

_NAVIGATION = {"velocity", "imu", "odometry"}
_REQUIRED = ("sonar", "velocity", "imu", "odometry")
"""Roles of which the wrong topic spoils a map; of the others the best guess is taken."""

# A type that says what it is goes before one that can hold anything.
_GENERAL_TYPES = {
    "sensor_msgs/msg/LaserScan": 1,
    "sensor_msgs/msg/PointCloud2": 2,
    "sensor_msgs/msg/PointCloud": 2,
    "sensor_msgs/msg/Image": 3,
    "sensor_msgs/msg/CompressedImage": 4,
    "std_msgs/msg/Float64": 1,
    "std_msgs/msg/Float32": 1,
    "geometry_msgs/msg/TwistWithCovarianceStamped": 1,
    "geometry_msgs/msg/TwistStamped": 2,
    "geometry_msgs/msg/Twist": 3,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 1,
    "geometry_msgs/msg/PoseStamped": 2,
    "nav_msgs/msg/Odometry": 1,
}
# Most of these topics come from something else: only a name makes one a sensor.
_NEEDS_A_NAME = {
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "std_msgs/msg/Float32",
    "std_msgs/msg/Float64", "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PointStamped",
}  # fmt: skip
NAMES_OF_ROLES = {
    "sonar": (
        "sonar", "oculus", "gemini", "ping360", "blueview", "aris", "didson", "fls", "mbes",
        "micron", "miniking", "ping", "scan", "points",
    ),
    "velocity": ("dvl", "velocity", "nucleus", "twist"),
    "imu": ("imu", "ahrs", "compass"),
    "depth": ("depth", "pressure", "baro"),
    "odometry": ("odometry", "odom", "ekf", "filtered", "pose", "localization"),
    "fix": ("fix", "usbl", "gps", "gnss", "navsat"),
}  # fmt: skip
_NUMBERS = {"std_msgs/msg/Float32", "std_msgs/msg/Float64"}
_HEADINGS = ("compass", "heading", "hdg")
"""What a number must be called to be a heading: an IMU has temperatures, too."""
_TRUTH = {"truth", "ground_truth", "groundtruth", "gt"}
# Words by which drivers are grouped; no vehicle has such a name.
_GROUPS = {
    "mavros", "sensor", "sensors", "instrument", "instruments", "payload", "nav", "navigation",
    "driver", "drivers", "device", "devices", "hardware", "hw", "raw", "data", "topics",
}  # fmt: skip
# Not measurements: what somebody wants, what has been made of a sensor, or a camera.
_NO_MEASUREMENT = {
    "cmd", "command", "desired", "setpoint", "goal", "reference", "target", "camera", "viewer",
    "visualization", "debug", "waypoint",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class VehicleTopics:
    """One vehicle's topics.

    Parameters
    ----------
    vehicle_id : its name.
    namespace : what its topics begin with, without slashes at the ends; "" where they share none.
    topics : role -> topic; `truth` and those of `_SENSORS` that were found.
    tables : indices of the tables (bags) that hold messages of it.
    unused : topics that could have played a role, and why they do not.
    """

    vehicle_id: str
    namespace: str
    topics: dict[str, str]
    tables: tuple[int, ...]
    unused: dict[str, str] = field(default_factory=dict)


def roles_of_type(msgtype: str) -> tuple[str, ...]:
    """Roles that a topic of this type can play; none for a type that nobody here reads."""
    if msgtype == "tf2_msgs/msg/TFMessage":
        return ("tf_static",)
    return ADAPTERS[msgtype].roles if msgtype in ADAPTERS else ()


def parts_of(topic: str) -> list[str]:
    """Components of a topic's name."""
    return topic.strip("/").split("/")


def find_vehicles(
    tables: Sequence[Mapping[str, str]],
    names: Sequence[str],
    settings_of: Callable[[str], SensorConfig] = lambda _: SensorConfig(),
) -> list[VehicleTopics]:
    """Vehicles in tables of topics, and what plays which role for each.

    Parameters
    ----------
    tables : topic -> type of every topic that has messages, one table for each bag (or one for a
        live graph).
    names : a name for each table, for vehicles whose topics have no namespace.
    settings_of : settings of a vehicle by its name: topics that are set, kinds of input.

    Returns
    -------
    list[VehicleTopics]
        In order of their names. Tables whose topics have the same namespace are one vehicle's.

    Raises
    ------
    DataError
        If two topics could equally well play a role, naming both and what to write; if a topic
        that is set is not there, or has a type that cannot play its role.
    """
    namespaces: dict[tuple[str, str], list[int]] = {}
    shared = _first_of_parts(tables, names)
    found = [(index, own) for index, table in enumerate(tables) for own in _namespaces(table)]
    shortened = _without_shared_ends([own for _, own in found])
    for (index, _), namespace in zip(found, shortened, strict=True):
        vehicle_id = parts_of(namespace)[-1] if namespace else shared or names[index]
        namespaces.setdefault((vehicle_id, namespace), []).append(index)
    ids = [vehicle_id for vehicle_id, _ in namespaces]
    vehicles = []
    for (vehicle_id, namespace), indices in sorted(namespaces.items()):
        if ids.count(vehicle_id) > 1 and namespace:
            vehicle_id = namespace.replace("/", "_")
        table = {topic: typ for index in indices for topic, typ in tables[index].items()}
        others = [n for _, n in namespaces if n != namespace and _is_below(n, namespace)]
        is_alone = len(namespaces) == 1
        topics, unused = topics_of(
            table, vehicle_id, namespace, settings_of(vehicle_id), others, is_alone=is_alone
        )
        vehicles.append(VehicleTopics(vehicle_id, namespace, topics, tuple(indices), unused))
    return vehicles


def topics_of(
    table: Mapping[str, str],
    vehicle_id: str,
    namespace: str,
    settings: SensorConfig,
    others: Sequence[str] = (),
    *,
    is_alone: bool = True,
) -> tuple[dict[str, str], dict[str, str]]:
    """Role -> topic of one vehicle, and topics that were left out -> why.

    `others` are namespaces of other vehicles below this one. A vehicle that `is_alone` may have
    sensors outside its namespace.
    """
    mine = {
        topic: msgtype
        for topic, msgtype in table.items()
        if _is_below(topic, namespace) and not any(_is_below(topic, other) for other in others)
    }
    topics: dict[str, str] = {}
    unused: dict[str, str] = {}
    set_topics = settings.topics.chosen()
    for role in (*_SENSORS, "truth"):
        allowed = {t: typ for t, typ in table.items() if settings.allows(role, typ)}
        if role in set_topics:
            topics[role] = _set_topic(table, vehicle_id, namespace, role, set_topics[role])
            continue
        found = _candidates({t: mine[t] for t in mine if t in allowed}, role, namespace)
        is_needless = role == "odometry" and "velocity" in topics
        if not found and is_alone and role != "truth" and not is_needless:
            found = _candidates(allowed, role, "")
        if not found:
            continue
        best = found[0]
        if role == "odometry" and {"velocity", "imu"} <= set(topics):
            # It is made of the same measurements: to use both would count them twice.
            unused |= {c[-1]: "dvl and imu are there themselves" for c in found}
            continue
        if len(found) > 1 and role in _REQUIRED and found[1][:-1] == best[:-1]:
            raise DataError(
                f"{vehicle_id}: two topics could be its {WORDS.get(role, role)}: {best[-1]} and "
                f"{found[1][-1]}; say which, with --topic {role}={best[-1]}, or in the settings "
                f"with topics: {{{role}: {best[-1]}}}"
            )
        topics[role] = best[-1]
        unused |= {c[-1]: f"{topics[role]} is the {WORDS.get(role, role)}" for c in found[1:]}
    return topics, {topic: why for topic, why in unused.items() if topic not in topics.values()}


def _set_topic(
    table: Mapping[str, str], vehicle_id: str, namespace: str, role: str, topic: str
) -> str:
    full = topic if topic.startswith("/") else f"/{namespace}/{topic}".replace("//", "/")
    if full not in table:
        raise DataError(
            f"{vehicle_id}: no topic {full} for its {WORDS.get(role, role)}; there are "
            f"{', '.join(sorted(table))}"
        )
    if role not in roles_of_type(table[full]):
        raise DataError(
            f"{vehicle_id}: topic {full} has type {table[full]}, which cannot be its "
            f"{WORDS.get(role, role)}"
        )
    return full


_Rank = tuple[int, int, int, int, str]


def _candidates(table: Mapping[str, str], role: str, namespace: str) -> list[_Rank]:
    """Topics that can play a role, best first: (type, name, level, raw, topic)."""
    depth = len(parts_of(namespace)) if namespace else 0
    found: list[_Rank] = []
    for topic, msgtype in table.items():
        parts = [part.lower() for part in parts_of(topic)]
        is_truth = bool(_TRUTH & set(parts))
        if role == "truth":
            if is_truth and msgtype == "nav_msgs/msg/Odometry":
                found.append((0, 0, len(parts), 0, topic))
            continue
        own = parts[depth:]
        roles = roles_of_type(msgtype)
        if is_truth or role not in roles or _is_no_measurement(own):
            continue
        words = _words(role, msgtype)
        if own == [words[0]] or (len(own) == 1 and own[0] in words):
            name = 0
        else:
            name = 1 if any(word in part for part in own for word in words) else 2
        if name == 2 and (
            msgtype in _NEEDS_A_NAME or role != roles[0] or _is_named(own, roles, msgtype)
        ):
            continue
        is_raw = any("raw" in part or "debug" in part for part in own)
        found.append((_GENERAL_TYPES.get(msgtype, 0), name, len(own), int(is_raw), topic))
    return sorted(found)


def _first_of_parts(tables: Sequence[Mapping[str, str]], names: Sequence[str]) -> str:
    """Name for tables that are parts of one vehicle (its sonar, its navigation), or ""."""
    bare = [i for i, table in enumerate(tables) if _namespaces(table) == [""]]
    roles = [
        {role for topic, typ in tables[i].items() for role in roles_of_type(typ)} for i in bare
    ]
    is_split = [bool("sonar" in r) != bool(r & _NAVIGATION) for r in roles]
    return names[bare[0]] if len(bare) > 1 and all(is_split) else ""


def _words(role: str, msgtype: str) -> tuple[str, ...]:
    """Words that name a role in topics of this type."""
    if role == "imu" and msgtype in _NUMBERS:
        return _HEADINGS
    return NAMES_OF_ROLES.get(role, ())


def _is_named(parts: Sequence[str], roles: Sequence[str], msgtype: str) -> bool:
    """Whether a topic's name says one of these roles."""
    words = [word for role in roles for word in _words(role, msgtype)]
    return any(word in part for part in parts for word in words)


def _is_no_measurement(parts: Sequence[str]) -> bool:
    return any(word in part for part in parts for word in _NO_MEASUREMENT)


# --- whose it is
# -----------------------------------------------------------------------------------------------


def _is_below(topic: str, namespace: str) -> bool:
    return not namespace or topic.strip("/").startswith(f"{namespace}/")


def _namespaces(table: Mapping[str, str]) -> list[str]:
    """Namespaces of the vehicles of one table; [""] where there is nothing to tell it by."""
    sensors: dict[tuple[str, ...], set[str]] = {}
    for topic, msgtype in table.items():
        parts = parts_of(topic)
        roles = {role for role in roles_of_type(msgtype) if role in _SENSORS}
        lowered = [part.lower() for part in parts]
        if msgtype in _NUMBERS:
            roles = {role for role in roles if _is_named(lowered, (role,), msgtype)}
        is_nameless = msgtype in _NEEDS_A_NAME and not _is_named(lowered, tuple(roles), msgtype)
        if roles and not _TRUTH & set(lowered) and not _is_no_measurement(lowered):
            if is_nameless:
                continue
            sensors[tuple(parts)] = roles
    return ["/".join(found) for found in _split(sensors, ())]


def _split(
    sensors: Mapping[tuple[str, ...], set[str]], prefix: tuple[str, ...]
) -> list[tuple[str, ...]]:
    """Prefixes of vehicles: as deep as nothing that a vehicle needs is lost on the way."""
    here = {parts: roles for parts, roles in sensors.items() if parts[: len(prefix)] == prefix}
    children: dict[str, set[str]] = {}
    for parts, roles in here.items():
        if len(parts) > len(prefix) + 1:
            children.setdefault(parts[len(prefix)], set()).update(roles)
    outside = set().union(*(r for p, r in here.items() if len(p) == len(prefix) + 1))
    if len(children) == 1 and not outside:
        return _split(sensors, (*prefix, next(iter(children))))
    complete = {c for c, roles in children.items() if "sonar" in roles and roles & _NAVIGATION}
    incomplete = set().union(outside, *(r for c, r in children.items() if c not in complete))
    if complete and all(_has_all(children[child], incomplete) for child in complete):
        return [found for child in sorted(complete) for found in _split(sensors, (*prefix, child))]
    return [_before_a_sensor(prefix)]


def _without_shared_ends(namespaces: Sequence[str]) -> list[str]:
    """``auv_1/hull`` and ``auv_2/hull`` are the vehicles auv_1 and auv_2."""
    all_parts = [parts_of(namespace) for namespace in namespaces]
    ends = zip(*(reversed(parts) for parts in all_parts), strict=False)
    for num_shared, last in enumerate(ends):
        if len(set(last)) > 1:
            return ["/".join(parts[: len(parts) - num_shared]) for parts in all_parts]
    return list(namespaces)  # of one vehicle, or one has nothing that the others have not


def _has_all(roles: set[str], others: set[str]) -> bool:
    """Whether a vehicle with these roles needs none of the others."""
    if "velocity" not in roles and "odometry" not in roles and others & {"velocity", "odometry"}:
        return False
    return "imu" in roles or "imu" not in others


def _before_a_sensor(prefix: tuple[str, ...]) -> tuple[str, ...]:
    """A lone ``/auv_1/imu/data`` is in namespace auv_1, not auv_1/imu or auv_1/sensors."""
    words = {word for group in NAMES_OF_ROLES.values() for word in group} | _GROUPS
    while prefix and prefix[-1].lower() in words:
        prefix = prefix[:-1]
    return prefix
