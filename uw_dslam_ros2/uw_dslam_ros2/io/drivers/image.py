"""``sensor_msgs``: Image and CompressedImage as fans, rows by range and columns by bearing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of, stamp_of
from uw_dslam_ros2.io.drivers.pixels import amplitudes, decoded, image_pixels
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import ImageEvent

__all__ = ["ADAPTERS", "read_compressed", "read_image"]


def read_image(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Fan of an ``Image``; its geometry comes from the settings, for the message has none."""
    if int(msg.height) == 0 or int(msg.width) == 0:
        return ()
    _check_geometry(settings)
    return (_fan(msg, image_pixels(msg), settings),)


def read_compressed(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Fan of a ``CompressedImage`` (JPEG, PNG)."""
    if len(msg.data) == 0:
        return ()
    _check_geometry(settings)
    return (_fan(msg, decoded(msg.data, "data"), settings),)


def _check_geometry(settings: ReadSettings) -> None:
    missing = [
        f"{name} ({meaning})"
        for name, meaning in (
            ("image_aperture_rad", "horizontal opening of the fan"),
            ("image_max_range_m", "range of its last row"),
        )
        if getattr(settings, name) <= 0.0
    ]
    if missing:
        raise InvalidInputError(
            "an image does not say which bearing and range its pixels have: set "
            f"{' and '.join(missing)}"
        )
    if settings.image_max_range_m <= settings.image_min_range_m:
        raise InvalidInputError(
            f"image_max_range_m is {settings.image_max_range_m}, expected more than "
            f"image_min_range_m = {settings.image_min_range_m}"
        )


def _fan(msg: Any, pixels: NDArray[Any], settings: ReadSettings) -> ImageEvent:
    num_ranges, num_beams = pixels.shape
    if settings.image_nearest_row == "bottom":
        pixels = pixels[::-1]
    span_m = settings.image_max_range_m - settings.image_min_range_m
    range_m = (
        settings.image_min_range_m
        + (np.arange(num_ranges, dtype=np.float64) + 0.5) * span_m / num_ranges
    )
    # The outermost beams look along the edges of the fan.
    half_rad = 0.5 * settings.image_aperture_rad
    bearing_rad = np.linspace(half_rad, -half_rad, num_beams)
    if settings.image_first_column == "starboard":
        bearing_rad = -bearing_rad
    image = SonarImage(stamp_of(msg), amplitudes(pixels, settings), range_m, bearing_rad)
    return ImageEvent(*key_of(msg, settings), image, None)


ADAPTERS = (
    Adapter("sensor_msgs/msg/Image", ("sonar",), read_image),
    Adapter("sensor_msgs/msg/CompressedImage", ("sonar",), read_compressed),
)
