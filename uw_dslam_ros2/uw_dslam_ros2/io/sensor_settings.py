"""How the messages of a vehicle's sensors are meant: settings of nodes and commands alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers import ReadSettings
from uw_dslam_ros2.io.drivers.settings import CHOICES, DATA_ORDERS

__all__ = ["INPUT_TYPES", "SENSOR_ROLES", "VELOCITY_TYPES", "SensorConfig", "TopicsConfig"]

SENSOR_ROLES = ("sonar", "velocity", "imu", "depth", "odometry", "fix")
"""What a topic can be to a mapper, beside the truth and transforms."""
_SAME_ROLE = {"dvl": "velocity", "scan": "sonar", "points": "sonar", "pressure": "depth"}

INPUT_TYPES = {
    "scan": ("sensor_msgs/msg/LaserScan",),
    "points": ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud"),
}
"""What the setting `input` leaves of a sonar's types; "image" leaves all others."""
VELOCITY_TYPES = {
    "twist": (
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "geometry_msgs/msg/TwistStamped",
    ),
}


@dataclass(frozen=True, slots=True)
class TopicsConfig(Config):
    """Topics by role; an empty one is found by its type.

    A name without a leading slash is below the vehicle's namespace.
    """

    sonar: str = setting("", doc="topic of the sonar; empty: found by its type")
    velocity: str = setting("", doc="topic of the DVL or other velocity; empty: found by its type")
    imu: str = setting("", doc="topic of the IMU or compass; empty: found by its type")
    depth: str = setting("", doc="topic of the pressure or depth; empty: found by its type")
    odometry: str = setting(
        "", doc="topic of the vehicle's own filter (Odometry, PoseStamped); empty: found"
    )
    fix: str = setting("", doc="topic of position fixes (USBL, GNSS); empty: found by its type")

    def chosen(self) -> dict[str, str]:
        """Topics that are set, by role."""
        values = {f.name: str(getattr(self, f.name)) for f in dataclass_fields(self)}
        return {role: topic for role, topic in values.items() if topic}

    @classmethod
    def of_options(cls, options: Iterable[str]) -> TopicsConfig:
        """From texts ``ROLE=TOPIC``; `ConfigError` names one that is not of that form."""
        values = {}
        for text in options:
            role, is_set, topic = text.partition("=")
            role = _SAME_ROLE.get(role, role)
            if not is_set or not topic or role not in SENSOR_ROLES:
                raise ConfigError(
                    f"topic {text!r}: expected ROLE=TOPIC with a role of {', '.join(SENSOR_ROLES)}"
                )
            values[role] = topic
        return cls(**values)

    def over(self, other: TopicsConfig) -> TopicsConfig:
        """These topics, and those of `other` where none is set here."""
        return TopicsConfig(**(other.chosen() | self.chosen()))


@dataclass(frozen=True, slots=True)
class SensorConfig(Config):
    """What the messages do not say of themselves."""

    base_frame: str = setting(
        "", doc="frame of the vehicle's body; empty: <vehicle>/base_link, or what tf has"
    )
    input: str = setting(
        "any",
        choices=("any", "image", "scan", "points"),
        doc="what the sonar sends; any: whatever is found",
        is_basic=True,
    )
    data_order: str = setting(
        "auto",
        choices=DATA_ORDERS,
        doc="slowest index of a sonar image's bytes; auto: found by the first images",
        is_basic=True,
    )
    velocity: str = setting(
        "any",
        choices=("any", "dvl", "twist"),
        doc="what the velocity sensor sends; any: whatever is found",
        is_basic=True,
    )
    water_density_kg_m3: float = setting(
        1025.0, 900.0, 1300.0, "turns pressure into depth; fresh water has 1000"
    )

    image_aperture_rad: float = setting(
        0.0, 0.0, 6.3, "opening of the fan in a plain Image, which does not say it [rad]"
    )
    image_max_range_m: float = setting(0.0, 0.0, 1000.0, "range of its farthest row [m]")
    image_min_range_m: float = setting(0.0, 0.0, 1000.0, "range where its nearest row begins [m]")
    image_nearest_row: str = setting(
        "top", choices=CHOICES["image_nearest_row"], doc="row of a plain Image that is nearest"
    )
    image_first_column: str = setting(
        "port",
        choices=CHOICES["image_first_column"],
        doc="side to which the left column of a plain Image looks",
    )
    sonar_angle_unit: str = setting(
        "radian", choices=CHOICES["sonar_angle_unit"], doc="unit of SonarEcho.angle"
    )
    scan_period_s: float = setting(
        0.0, 0.0, 600.0, "time of a turn of a LaserScan [s]; 0: as the message says"
    )
    scan_stamp: str = setting(
        "first", choices=CHOICES["scan_stamp"], doc="ray that a LaserScan's stamp belongs to"
    )
    point_max_height_m: float = setting(
        1.0, 0.0, 1000.0, "points further above or below the sonar are left out [m]"
    )
    pressure: str = setting(
        "auto", choices=CHOICES["pressure"], doc="what a pressure is measured against"
    )
    topics: TopicsConfig = TopicsConfig()
    conventions: Conventions = setting(Conventions())

    def read_settings(
        self, vehicle_id: str, role: str, tell: Callable[[Finding], None]
    ) -> ReadSettings:
        """These settings, for the adapter of one topic."""
        own = {field.name for field in dataclass_fields(SensorConfig)}
        shared = [f.name for f in dataclass_fields(ReadSettings) if f.name in own]
        values = {name: getattr(self, name) for name in shared}
        return ReadSettings(vehicle_id=vehicle_id, role=role, tell=tell, **values)

    def allows(self, role: str, msgtype: str) -> bool:
        """Whether a topic of this type may play this role."""
        if role == "sonar" and self.input != "any":
            kinds = [kind for kind, types in INPUT_TYPES.items() if msgtype in types] or ["image"]
            return self.input in kinds
        if role == "velocity" and self.velocity != "any":
            return (msgtype in VELOCITY_TYPES["twist"]) == (self.velocity == "twist")
        return True
