"""What messages do not say about themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.findings import Finding

__all__ = ["DATA_ORDERS", "MessageConfig", "ReadSettings"]

DATA_ORDERS = ("range_major", "beam_major")
"""The slowest index of a sonar image's bytes: range (index = range * beams + beam), or beam."""


@dataclass(frozen=True, slots=True)
class MessageConfig(Config):
    """How a vehicle's messages are read, where their definition leaves it open."""

    data_order: str = setting(
        "range_major",
        choices=DATA_ORDERS,
        doc="slowest index of a sonar image's bytes",
        is_basic=True,
    )
    water_density_kg_m3: float = setting(
        1025.0, 900.0, 1300.0, "turns pressure into depth; fresh water has 1000"
    )
    pressure: str = setting(
        "auto",
        choices=("auto", "absolute", "gauge"),
        doc="what a FluidPressure is; auto: gauge (or mbar) where too little to be absolute in Pa",
    )
    image_aperture_rad: float = setting(
        0.0, 0.0, 6.3, "horizontal opening of a sonar's sensor_msgs/Image [rad]; 0: not known"
    )
    image_max_range_m: float = setting(
        0.0, 0.0, 10000.0, "range where a sonar's sensor_msgs/Image ends [m]; 0: not known"
    )
    image_min_range_m: float = setting(
        0.0, 0.0, 10000.0, "range where a sonar's sensor_msgs/Image begins [m]"
    )
    image_nearest_row: str = setting(
        "top", choices=("top", "bottom"), doc="row of a sonar's sensor_msgs/Image that is nearest"
    )
    image_first_column: str = setting(
        "port",
        choices=("port", "starboard"),
        doc="side where the left column of a sonar's sensor_msgs/Image looks",
    )
    sonar_angle_unit: str = setting(
        "radian", choices=("radian", "degree", "gradian"), doc="unit of SonarEcho.angle (Ping360)"
    )
    scan_period_s: float = setting(
        0.0, 0.0, 600.0, "time of a turn in a LaserScan [s]; 0: as time_increment or scan_time say"
    )
    scan_stamp: str = setting(
        "first", choices=("first", "last"), doc="ray that a LaserScan's stamp belongs to"
    )
    point_max_height_m: float = setting(
        1.0, 0.0, 10000.0, "points further above or below the sonar are left out [m]"
    )


def _say_nothing(finding: Finding) -> None:
    del finding


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """How the messages of one topic are read; make one per topic, and keep it.

    Parameters
    ----------
    vehicle_id : whose the readings are.
    role : what the topic is used for, one of its adapter's roles; "" is the first of them.
    config : what the messages leave open.
    tell : called with what is noticed about the messages.
    memory : what adapters remember of this topic from one message to the next.
    """

    vehicle_id: str = ""
    role: str = ""
    config: MessageConfig = MessageConfig()
    tell: Callable[[Finding], None] = field(default=_say_nothing, compare=False, repr=False)
    memory: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def tell_once(self, finding: Finding) -> None:
        """Tell of something that holds for the whole topic, at its first sight."""
        if finding.kind not in self.memory:
            self.memory[finding.kind] = True
            self.tell(finding)
