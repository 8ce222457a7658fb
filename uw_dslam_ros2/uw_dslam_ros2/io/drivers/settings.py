"""What messages do not say about themselves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding

__all__ = ["CHOICES", "DATA_ORDERS", "ReadSettings"]

DATA_ORDERS = ("auto", "range_major", "beam_major")
"""The slowest index of a sonar image's bytes: range (index = range * beams + beam), or beam."""

CHOICES: dict[str, tuple[str, ...]] = {
    "data_order": DATA_ORDERS,
    "image_nearest_row": ("top", "bottom"),
    "image_first_column": ("port", "starboard"),
    "sonar_angle_unit": ("radian", "degree", "gradian"),
    "scan_stamp": ("first", "last"),
    "pressure": ("auto", "absolute", "gauge"),
}
"""What the settings that are words may say."""


def _say_nothing(finding: Finding) -> None:
    del finding


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """How the messages of one topic are read; make one per topic.

    Parameters
    ----------
    vehicle_id : whose the readings are.
    role : what the topic is used for, one of its adapter's roles; "" is the first of them.
    data_order : slowest index of a ``ProjectedSonarImage``'s or ``RawSonarImage``'s bytes; "auto"
        is found by the first images: neighbours look alike.
    water_density_kg_m3 : turns pressure into depth.
    image_aperture_rad, image_max_range_m : fan of a ``sensor_msgs/Image``, whose rows are ranges
        and whose columns are beams; 0: not known.
    image_min_range_m : range where the image's nearest row begins.
    image_nearest_row : "top" or "bottom".
    image_first_column : side where the image's left column looks, "port" or "starboard".
    sonar_angle_unit : of ``SonarEcho.angle``.
    scan_period_s : time of a turn of a ``LaserScan``; 0: as the message says.
    scan_stamp : the ray that a ``LaserScan``'s stamp belongs to.
    point_max_height_m : points further above or below the sonar are left out.
    pressure : "auto" takes for gauge what is too little to be absolute.
    tell : called with what is noticed about the messages.
    memory : what adapters remember of this topic from one message to the next.
    """

    vehicle_id: str = ""
    role: str = ""
    data_order: str = "auto"
    water_density_kg_m3: float = 1025.0
    image_aperture_rad: float = 0.0
    image_max_range_m: float = 0.0
    image_min_range_m: float = 0.0
    image_nearest_row: str = "top"
    image_first_column: str = "port"
    sonar_angle_unit: str = "radian"
    scan_period_s: float = 0.0
    scan_stamp: str = "first"
    point_max_height_m: float = 1.0
    pressure: str = "auto"
    tell: Callable[[Finding], None] = field(default=_say_nothing, compare=False, repr=False)
    memory: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise InvalidInputError(
                    f"{name} is {getattr(self, name)!r}, expected one of {choices}"
                )
        for name in (
            "image_aperture_rad", "image_max_range_m", "image_min_range_m", "scan_period_s",
            "point_max_height_m", "water_density_kg_m3",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidInputError(f"{name} is {value}, expected a number of at least 0")

    def tell_once(self, finding: Finding) -> None:
        """Tell of something that holds for the whole topic, at its first sight."""
        if finding.kind not in self.memory:
            self.memory[finding.kind] = True
            self.tell(finding)
