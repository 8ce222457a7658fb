"""``marine_acoustic_msgs``: ProjectedSonarImage and RawSonarImage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.mounting import ForwardAxis
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of, stamp_of
from uw_dslam_ros2.io.drivers.pixels import amplitudes, pixels_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import ImageEvent

__all__ = ["ADAPTERS", "read_projected", "read_raw"]

# By the constants of SonarImageData.
_PIXEL_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
_NUM_IMAGES = 10  # that are asked for the order of their bytes
_CLEARLY = 0.3
_FARTHEST_M = 2000.0
"""No sonar that is mapped with sees farther; ranges that do are in millimetres."""
_MILLIMETRES = Finding(
    "sonar_range_unit",
    "sonar",
    "its ranges go beyond 2000: they are taken for millimetres, where the message has metres; "
    "mend the driver",
)
_DEGREES = Finding(
    "sonar_angle_unit",
    "sonar",
    "its rx_angles go beyond a turn: they are taken for degrees, where the message has radians; "
    "mend the driver",
)
_BY_BEAM = Finding(
    "sonar_data_order",
    "sonar",
    "its images are stored beam by beam, not range by range; they are read so "
    "(data_order: beam_major)",
    severity="info",
)


def read_projected(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Image of a ``ProjectedSonarImage``.

    By its definition the frame is z forward, x up, y to starboard: bearing = atan2(-y, z). The
    simulator DAVE and some drivers have x forward and y to port instead; their beams have no z.
    """
    range_m = np.asarray(msg.ranges, dtype=np.float64)
    directions = np.array([(d.x, d.y, d.z) for d in msg.beam_directions]).reshape(-1, 3)
    num_beams, num_ranges = int(msg.image.beam_count), len(range_m)
    if len(directions) != num_beams:
        raise InvalidInputError(
            f"beam_directions has {len(directions)} entries, expected beam_count = {num_beams}"
        )
    if num_beams == 0 or num_ranges == 0:
        return ()  # a sonar that has not begun to ping
    steps = np.diff(range_m)
    if not (np.isfinite(range_m).all() and ((steps > 0.0).all() or (steps < 0.0).all())):
        raise InvalidInputError("ranges are not finite and rising (or falling)")
    if range_m.max() > _FARTHEST_M:
        settings.tell_once(_MILLIMETRES)
        range_m = range_m * 1e-3
    bearing_rad, forward = _bearings(directions)
    return (_image_event(msg, settings, range_m, bearing_rad, forward),)


def _bearings(directions: NDArray[np.float64]) -> tuple[NDArray[np.float64], ForwardAxis]:
    size = np.abs(directions).sum(axis=0)
    forward: ForwardAxis = "x" if size[0] > size[2] else "z"
    ahead = directions[:, 0 if forward == "x" else 2]
    to_port = directions[:, 1] * (1.0 if forward == "x" else -1.0)
    if not (np.isfinite(directions).all() and (np.hypot(ahead, to_port) > 0.1).all()):
        raise InvalidInputError(
            f"beam_directions holds a vector without a bearing (y, {forward} both near 0)"
        )
    return np.arctan2(to_port, ahead), forward


def read_raw(msg: Any, settings: ReadSettings) -> Sequence[ImageEvent]:
    """Image of a ``RawSonarImage``.

    Its ``rx_angles`` steer to starboard; sample s lies at (sample0 + s) / sample_rate, twice the
    way.
    """
    bearing_rad = -np.asarray(msg.rx_angles, dtype=np.float64)
    num_samples, rate_hz = int(msg.samples_per_beam), float(msg.sample_rate)
    sound_speed_m_s = float(msg.ping_info.sound_speed)
    if len(bearing_rad) != int(msg.image.beam_count):
        raise InvalidInputError(
            f"rx_angles has {len(bearing_rad)} entries, "
            f"expected beam_count = {int(msg.image.beam_count)}"
        )
    if len(bearing_rad) == 0 or num_samples == 0:
        return ()
    if not np.isfinite(bearing_rad).all():
        raise InvalidInputError("rx_angles holds values that are not finite")
    for name, value in (("sample_rate", rate_hz), ("ping_info.sound_speed", sound_speed_m_s)):
        if not (np.isfinite(value) and value > 0.0):
            raise InvalidInputError(f"{name} is {value}, expected a positive number")
    if np.abs(bearing_rad).max() > 2.0 * np.pi:
        settings.tell_once(_DEGREES)
        bearing_rad = np.radians(bearing_rad)
    samples = float(msg.sample0) + np.arange(num_samples, dtype=np.float64) + 0.5
    range_m = samples / rate_hz * sound_speed_m_s / 2.0
    return (_image_event(msg, settings, range_m, bearing_rad, None),)


def _image_event(
    msg: Any,
    settings: ReadSettings,
    range_m: NDArray[np.float64],
    bearing_rad: NDArray[np.float64],
    forward: ForwardAxis | None,
) -> ImageEvent:
    code = int(msg.image.dtype)
    if not 0 <= code < len(_PIXEL_TYPES):
        raise InvalidInputError(f"image.dtype is {code}, expected 0 to {len(_PIXEL_TYPES) - 1}")
    dtype = np.dtype((">" if msg.image.is_bigendian else "<") + _PIXEL_TYPES[code])
    shape = (len(range_m), len(bearing_rad))
    pixels = pixels_of(msg.image.data, dtype, shape, "image.data")
    if _order_of(pixels, settings) == "beam_major":
        pixels = pixels.reshape(shape[::-1]).T
    if range_m[0] > range_m[-1]:
        range_m, pixels = range_m[::-1], pixels[::-1]
    image = SonarImage(stamp_of(msg), amplitudes(pixels, settings), range_m, bearing_rad)
    return ImageEvent(*key_of(msg, settings), image, forward)


def _order_of(pixels: NDArray[Any], settings: ReadSettings) -> str:
    """Slowest index of the bytes: as set, or as the first images that say something have it.

    Next to a pixel along the slow index lies its neighbour, one whole beam or range further in
    the bytes; at the distance that the other order would have lies a stranger.
    """
    if settings.data_order != "auto":
        return settings.data_order
    if "data_order" in settings.memory:
        return str(settings.memory["data_order"])
    num_ranges, num_beams = pixels.shape
    if num_ranges == num_beams or min(pixels.shape) < 2:
        return "range_major"
    flat = pixels.reshape(-1).astype(np.float64)
    flat[~np.isfinite(flat)] = 0.0
    flat -= flat.mean()
    power = float(flat @ flat)
    if power > 0.0:
        sums = settings.memory.setdefault("data_order_sums", [0, 0.0])
        sums[0] += 1
        sums[1] += _alike(flat, num_beams, power) - _alike(flat, num_ranges, power)
        if sums[0] >= _NUM_IMAGES:
            is_by_beam = sums[1] / sums[0] < -_CLEARLY
            if is_by_beam:
                settings.tell_once(_BY_BEAM)
            settings.memory["data_order"] = "beam_major" if is_by_beam else "range_major"
        return "beam_major" if sums[1] / sums[0] < -_CLEARLY else "range_major"
    return "range_major"


def _alike(flat: NDArray[np.float64], step: int, power: float) -> float:
    """Correlation of pixels that lie a step apart."""
    return float(flat[step:] @ flat[:-step]) / power


ADAPTERS = tuple(
    Adapter(f"{package}/msg/{name}", ("sonar",), read)
    for package in ("marine_acoustic_msgs", "acoustic_msgs")
    for name, read in (("ProjectedSonarImage", read_projected), ("RawSonarImage", read_raw))
)
