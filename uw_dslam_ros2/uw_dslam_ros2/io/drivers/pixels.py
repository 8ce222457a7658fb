"""Pixels of sonar images: types, byte order, decibels, compression."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers.adapter import as_bytes
from uw_dslam_ros2.io.drivers.settings import ReadSettings

__all__ = ["amplitudes", "decoded", "image_pixels", "pixels_of", "without_pedestal"]

Pixels = NDArray[np.generic]

_ENCODINGS = {
    "mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4", "64FC1": "f8",
}  # fmt: skip
_COLORS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4}
_ROUGH = 0.15
_SMOOTH = 0.4
_MIN_VALUES = 8
_FLOOR_DB = -200.0
_PEDESTAL = 0.5
"""Share of their median from which on the least of the pixels is no noise, but an offset."""
_MOST_EMPTY = 0.5  # of an image that stands on one: a sector may be blanked


def pixels_of(data: Any, dtype: np.dtype[Any], shape: tuple[int, int], field: str) -> Pixels:
    """View bytes as an image of this shape, in the machine's own byte order."""
    raw = as_bytes(data, field)
    expected = shape[0] * shape[1] * dtype.itemsize
    if len(raw) != expected:
        raise InvalidInputError(
            f"{field} has {len(raw)} bytes, expected {expected} "
            f"({shape[0]} x {shape[1]} pixels of {dtype.itemsize} bytes)"
        )
    return raw.view(dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)


def amplitudes(pixels: Pixels, settings: ReadSettings) -> Pixels:
    """Repair what is certainly not meant as it stands: swapped bytes, decibels, a pedestal.

    16 bits of a real echo have a smooth high byte and a rough low one; the other way round, or
    with a high byte that never changes and is not 0, the message's byte order is wrong. Reals
    that are negative are decibels, as the simulator DAVE has them: an amplitude has no sign.
    Silence is 0: where no pixel comes near it, an offset was added, which hides the contrast.
    """
    if pixels.dtype.kind == "u" and pixels.dtype.itemsize == 2:
        if "is_swapped" not in settings.memory:
            verdict = _is_swapped(pixels)
            if verdict is not None:
                settings.memory["is_swapped"] = verdict
        if settings.memory.get("is_swapped", False):
            settings.tell_once(
                Finding(
                    "sonar_byte_order",
                    "sonar",
                    "the bytes of its 16-bit images are in the other order than the messages say "
                    "(is_bigendian); they were swapped: mend the driver",
                )
            )
            return without_pedestal(pixels.byteswap())
    if pixels.dtype.kind == "f":
        values = pixels.astype(np.float64)
        if "is_db" not in settings.memory and (np.isfinite(values) & (values != 0.0)).any():
            settings.memory["is_db"] = bool((values < 0.0).mean() > 0.05)
        if settings.memory.get("is_db", False):
            values[~(values > _FLOOR_DB)] = _FLOOR_DB  # log of 0 is -inf
            amplitude = 10.0 ** (values / 20.0)
            # Thresholds are shares of full scale, which for reals is 1.
            peak = max(float(amplitude.max()), settings.memory.get("peak", 0.0))
            settings.memory["peak"] = peak
            return np.asarray(amplitude / peak, np.float32)
        if np.isnan(values).any():
            pixels = np.where(np.isnan(values), 0.0, pixels)  # nothing was measured there
    return without_pedestal(pixels)


def without_pedestal(pixels: Pixels) -> Pixels:
    """Pixels less the least of them, where that is far from 0; pixels of 0 were blanked."""
    is_said = pixels > 0  # type: ignore[operator]  # numbers
    if is_said.mean() <= _MOST_EMPTY:
        return pixels
    said = pixels[is_said]
    floor = said.min()
    if float(floor) <= _PEDESTAL * float(np.median(said)) or floor == said.max():
        return pixels
    return np.where(is_said, pixels - floor, pixels).astype(pixels.dtype)


def _is_swapped(pixels: Pixels) -> bool | None:
    """Whether 16-bit pixels have the wrong byte order; None: cannot tell from this image."""
    values = np.ascontiguousarray(pixels, dtype=np.uint16)
    high, low = values >> 8, values & 0xFF
    num_high, num_low = len(np.unique(high)), len(np.unique(low))
    if num_high == 1:
        if num_low < _MIN_VALUES:
            return None
        return bool(high.flat[0])
    if num_high < _MIN_VALUES or num_low == 1:
        return False if num_low == 1 else None
    smooth_high, smooth_low = _smoothness(high), _smoothness(low)
    if smooth_low > _SMOOTH and smooth_high < _ROUGH:
        return True
    if smooth_high > _SMOOTH:
        return False
    return None


def _smoothness(plane: Pixels) -> float:
    """Correlation of neighbours, along ranges or beams, whichever is larger."""
    values = plane.astype(np.float64)
    values -= values.mean()
    power = float((values * values).mean())
    if power == 0.0:
        return 0.0
    along = [
        float((values[1:] * values[:-1]).mean()) if values.shape[0] > 1 else 0.0,
        float((values[:, 1:] * values[:, :-1]).mean()) if values.shape[1] > 1 else 0.0,
    ]
    return max(along) / power


def image_pixels(msg: Any, field: str = "data") -> Pixels:
    """Pixels (height, width) of a ``sensor_msgs/Image`` in shades of grey."""
    height, width, encoding = int(msg.height), int(msg.width), str(msg.encoding)
    num_channels = _COLORS.get(encoding, 1)
    if encoding not in _ENCODINGS and encoding not in _COLORS:
        raise InvalidInputError(
            f"encoding is {encoding!r}, expected one of {', '.join(sorted(_ENCODINGS))}"
        )
    order = ">" if msg.is_bigendian else "<"
    dtype = np.dtype(order + _ENCODINGS.get(encoding, "u1"))
    raw = as_bytes(msg.data, field)
    row, step = width * num_channels * dtype.itemsize, int(msg.step)
    # Some drivers write another step than the one they use; the length tells.
    if len(raw) == height * step and step > row:
        raw = np.ascontiguousarray(raw.reshape(height, step)[:, :row]).reshape(-1)
    pixels = pixels_of(raw, dtype, (height, width * num_channels), field)
    return pixels if num_channels == 1 else _grey(pixels.reshape(height, width, -1), encoding)


def decoded(data: Any, field: str) -> Pixels:
    """Pixels of a JPEG or PNG."""
    import cv2  # large, and not every program has pictures

    raw = as_bytes(data, field)
    image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if len(raw) else None
    if image is None:
        raise InvalidInputError(f"{field} ({len(raw)} bytes) is no JPEG or PNG")
    return image if image.ndim == 2 else _grey(image, "a compressed colour image")


def _grey(image: NDArray[Any], encoding: str) -> Pixels:
    colors = image[:, :, :3].astype(np.int16)
    # Compression blurs colours a little; a palette does not look like that.
    if np.abs(colors - colors.mean(axis=2, keepdims=True)).max(initial=0.0) > 8.0:
        raise InvalidInputError(
            f"encoding is {encoding} with colours, expected shades of grey (mono8, mono16): "
            "a coloured picture is for people; use the topic with the raw image"
        )
    return np.asarray(colors[:, :, 1], np.uint8)
