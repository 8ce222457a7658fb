"""Blueprint Oculus: ``oculus_interfaces/Ping`` (ENSTA) and ``sonar_oculus/OculusPing`` (BRUCE).

Both have bearings in hundredths of a degree, growing to starboard, and rows from the nearest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.drivers.adapter import Adapter, as_bytes, key_of, stamp_of
from uw_dslam_ros2.io.drivers.pixels import amplitudes, decoded, image_pixels
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import ImageEvent

__all__ = ["ADAPTERS", "read_bruce", "read_ensta"]

_BYTES_OF_GAIN = 4


def read_ensta(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Image of an ``oculus_interfaces/Ping``, each row divided by the root of its gain.

    ``ping_data`` may hold the sonar's whole packet, of which the image is the end.
    """
    num_ranges, num_beams, step = int(msg.n_ranges), int(msg.n_beams), int(msg.step)
    if num_ranges == 0 or num_beams == 0:
        return ()
    size = int(msg.sample_size)
    if size not in (1, 2, 4):
        raise InvalidInputError(f"sample_size is {size}, expected 1, 2 or 4 bytes")
    offset = _BYTES_OF_GAIN if msg.has_gains else 0
    if step != offset + num_beams * size:
        raise InvalidInputError(
            f"step is {step}, expected {offset + num_beams * size} "
            f"({num_beams} beams of {size} bytes, {offset} bytes of gain)"
        )
    data = as_bytes(msg.ping_data, "ping_data")
    if len(data) < num_ranges * step:
        raise InvalidInputError(
            f"ping_data has {len(data)} bytes, expected at least n_ranges x step = "
            f"{num_ranges} x {step}"
        )
    rows = data[len(data) - num_ranges * step :].reshape(num_ranges, step)
    pixels: NDArray[Any] = np.ascontiguousarray(rows[:, offset:]).view(f"<u{size}")
    if msg.has_gains:
        gains = np.ascontiguousarray(rows[:, :offset]).view("<u4").astype(np.float64)
        if (gains == 0.0).any():
            raise InvalidInputError("ping_data has a row with gain 0, expected a positive gain")
        # Shares of full scale at the least gain, so that no row exceeds it.
        scale = np.sqrt(gains.min() / gains) / (2.0 ** (8 * size) - 1.0)
        pixels = (pixels * scale).astype(np.float32)
    return (_event(msg, settings, pixels, num_ranges, num_beams),)


def read_bruce(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Image of a ``sonar_oculus/OculusPing``: compressed, or (Uncompressed, older) an Image."""
    num_ranges, num_beams = int(msg.num_ranges), len(msg.bearings)
    if num_ranges == 0 or num_beams == 0:
        return ()
    is_raw = hasattr(msg.ping, "encoding")
    pixels = image_pixels(msg.ping, "ping.data") if is_raw else decoded(msg.ping.data, "ping.data")
    if pixels.shape != (num_ranges, num_beams):
        raise InvalidInputError(
            f"ping has the shape {pixels.shape}, expected (num_ranges, bearings) = "
            f"({num_ranges}, {num_beams})"
        )
    return (_event(msg, settings, pixels, num_ranges, num_beams),)


def _event(
    msg: Any, settings: ReadSettings, pixels: NDArray[Any], num_ranges: int, num_beams: int
) -> ImageEvent:
    resolution_m = float(msg.range_resolution)
    if not (np.isfinite(resolution_m) and resolution_m > 0.0):
        raise InvalidInputError(f"range_resolution is {resolution_m}, expected a positive number")
    if len(msg.bearings) != num_beams:
        raise InvalidInputError(
            f"bearings has {len(msg.bearings)} entries, expected one per beam ({num_beams})"
        )
    bearing_rad = -np.radians(np.asarray(msg.bearings, dtype=np.float64) * 0.01)
    range_m = (np.arange(num_ranges, dtype=np.float64) + 0.5) * resolution_m
    image = SonarImage(stamp_of(msg), amplitudes(pixels, settings), range_m, bearing_rad)
    return ImageEvent(*key_of(msg, settings), image, None)


ADAPTERS = (
    Adapter("oculus_interfaces/msg/Ping", ("sonar",), read_ensta),
    Adapter("sonar_oculus/msg/OculusPing", ("sonar",), read_bruce),
    Adapter("sonar_oculus/msg/OculusPingUncompressed", ("sonar",), read_bruce),
)
