"""Which topics a mapper reads, and what their messages become."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers import ADAPTERS, stamp_of
from uw_dslam_ros2.io.feeding import SensorEvent
from uw_dslam_ros2.io.topics import topics_of
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig

__all__ = ["SensorInput", "check_stamp", "default_inputs", "found_inputs"]

_PING_QUEUE = 100
"""Pings kept while the mapper is busy: ten seconds at 10 Hz, and an image is large."""
_SENSOR_QUEUE = 5000
"""Other messages kept meanwhile: half a minute of a fast IMU; nearly nothing in memory."""

_MAX_AHEAD_NS = 60_000_000_000
"""The clock of a replay is as late as the node is busy: more than a player lets a mapper lag."""
_NAMES = {"velocity": "dvl"}
_SONARS = {
    "scan": ("scan", "sensor_msgs/msg/LaserScan"),
    "points": ("points", "sensor_msgs/msg/PointCloud2"),
}
_IMAGE = ("sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")


@dataclass(frozen=True, slots=True)
class SensorInput:
    """One topic, by its role; ``name`` is what it is called in diagnostics.

    ``to_events`` takes a message and the time of now [ns], which those without a header get; it
    gives nothing for a message without a value (no bottom lock).
    """

    role: str
    name: str
    topic: str
    msgtype: str
    to_events: Callable[[Any, int], Sequence[SensorEvent]]

    @property
    def queue_depth(self) -> int:
        """Messages kept while the mapper is busy; a scan or an echo may be a single beam."""
        is_small = self.role != "sonar" or self.msgtype.endswith(("/LaserScan", "/SonarEcho"))
        return _SENSOR_QUEUE if is_small else _PING_QUEUE

    @property
    def msg_type(self) -> Any:
        """Class of the messages; `DataError` where their package is not installed."""
        package, _, name = self.msgtype.split("/")
        try:
            return getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError) as error:
            raise DataError(
                f"topic {self.topic} has type {self.msgtype}, whose package {package} is not "
                "installed"
            ) from error


def default_inputs(
    config: SonarMapperConfig, vehicle_id: str, tell: Callable[[Finding], None]
) -> tuple[SensorInput, ...]:
    """Pings, velocity, heading and depth under their usual names, where none are set.

    They are subscribed to before anybody sends, so that nothing of a replay is missed.
    """
    velocity = "geometry_msgs/msg/TwistWithCovarianceStamped"
    usual = {
        "sonar": _SONARS.get(config.input, _IMAGE),
        "velocity": (
            "dvl",
            velocity if config.velocity == "twist" else "marine_acoustic_msgs/msg/Dvl",
        ),
        "imu": ("imu", "sensor_msgs/msg/Imu"),
        "depth": ("depth", "sensor_msgs/msg/FluidPressure"),
    }
    return tuple(
        _input(config, vehicle_id, tell, role, name, name, msgtype)
        for role, (name, msgtype) in usual.items()
        if role not in config.topics.chosen()
    )


def found_inputs(
    config: SonarMapperConfig,
    vehicle_id: str,
    namespace: str,
    table: Mapping[str, str],
    tell: Callable[[Finding], None],
) -> tuple[SensorInput, ...]:
    """What plays which role among topics (name -> type) that somebody sends now.

    Raises
    ------
    DataError
        If two could equally well play a role; it says what to write.
    """
    topics = topics_of(table, vehicle_id, namespace, config, is_alone=False)[0]
    return tuple(
        _input(config, vehicle_id, tell, role, _NAMES.get(role, role), topic, table[topic])
        for role, topic in topics.items()
        if role != "truth"
    )


def _input(
    config: SonarMapperConfig,
    vehicle_id: str,
    tell: Callable[[Finding], None],
    role: str,
    name: str,
    topic: str,
    msgtype: str,
) -> SensorInput:
    settings = config.read_settings(vehicle_id, role, tell)

    def to_events(msg: Any, now_ns: int) -> Sequence[SensorEvent]:
        found = ADAPTERS[msgtype].read(msg, settings)
        if stamp_of(msg) or hasattr(msg, "header"):
            return found
        return [dataclasses.replace(event, stamp_ns=now_ns) for event in found]

    return SensorInput(role, name, topic, msgtype, to_events)


def check_stamp(msg: Any, now_ns: int) -> None:
    """Refuse a message that says no time of measurement, or one far ahead of the clock.

    Raises
    ------
    InvalidInputError
        With the stamp; never for a type without a header.
    """
    if not hasattr(msg, "header"):
        return
    stamp_ns = stamp_of(msg)
    if stamp_ns <= 0:
        raise InvalidInputError(
            f"header.stamp is {stamp_ns * 1e-9} s, expected the time of the measurement"
        )
    if 0 < now_ns < stamp_ns - _MAX_AHEAD_NS:
        raise InvalidInputError(
            f"header.stamp is {(stamp_ns - now_ns) * 1e-9:.1f} s ahead of the clock, "
            f"expected at most {_MAX_AHEAD_NS * 1e-9:.0f} s"
        )
