"""Images of maps, decoded: PGM, PNG, BMP. Too large ones are refused before that."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError

__all__ = ["MAX_SIDE", "read_image"]

MAX_SIDE = 20_000
"""Most pixels of a side."""

_PNG = b"\x89PNG\r\n\x1a\n"
_NUMBER = rb"(?:#[^\r\n]*[\r\n]|\s)+(\d{1,9})"
_PBM_HEADER = re.compile(rb"P[14]" + 2 * _NUMBER)
_PNM_HEADER = re.compile(rb"P[2356]" + 3 * _NUMBER)  # PGM, and PPM with three colours


def read_image(path: Path) -> tuple[NDArray[Any], int]:
    """Pixels (R, C) or (R, C, channels), alpha last of four; and the value of white.

    The first row is the image's top.

    Raises
    ------
    DataError
        Naming the file and what is wrong with it.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    if content[:2] in (b"P2", b"P3", b"P5", b"P6"):
        return _read_pnm(path, content)
    size = _size_of(content)
    if size is not None:
        _check_size(path, *size)
    return _decode(path, content)


def _check_size(path: Path, width: int, height: int) -> None:
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(
            f"{path}: the image has {width} x {height} pixels, expected at least 1 and at most "
            f"{MAX_SIDE} a side"
        )


def _size_of(content: bytes) -> tuple[int, int] | None:
    """Width and height by the header; None where that is not known."""
    if content.startswith(_PNG) and len(content) >= 24:
        return struct.unpack(">II", content[16:24])
    if content.startswith(b"BM") and len(content) >= 26:
        if struct.unpack("<I", content[14:18])[0] == 12:  # the oldest form of the header
            return struct.unpack("<HH", content[18:22])
        width, height = struct.unpack("<ii", content[18:26])
        return width, abs(height)
    header = _PBM_HEADER.match(content)
    return None if header is None else (int(header[1]), int(header[2]))


def _read_pnm(path: Path, content: bytes) -> tuple[NDArray[Any], int]:
    """Read it here: decoders fill truncated files up, with walls, and differ in what white is."""
    header = _PNM_HEADER.match(content)
    width, height, white = (int(number) for number in header.groups()) if header else (0, 0, 0)
    if header is None or not 1 <= white <= 65535 or min(width, height) < 1:
        raise DataError(
            f"{path}: the PGM header is broken, expected width, height and largest value"
        )
    _check_size(path, width, height)
    is_plain, num_channels = (
        content[:2] in (b"P2", b"P3"),
        3 if content[:2] in (b"P3", b"P6") else 1,
    )
    pixels: NDArray[Any]
    if is_plain:
        pixels, size, unit = _plain_pixels(path, content[header.end() :]), 1, "numbers"
    else:
        start = min(header.end() + 1, len(content))  # one white space ends the header
        pixels, unit = np.frombuffer(content, np.uint8, offset=start), "bytes"
        size = 2 if white > 255 else 1
    expected = width * height * num_channels * size
    if len(pixels) < expected:
        raise DataError(
            f"{path} is truncated: {len(pixels)} {unit} of pixels, expected {expected}"
        )
    pixels = pixels[:expected].view(">u2") if size == 2 else pixels[:expected]
    if int(pixels.max()) > white:
        raise DataError(f"{path}: a pixel is {pixels.max()}, expected at most {white}")
    shape = (height, width) if num_channels == 1 else (height, width, num_channels)
    return pixels.reshape(shape), white


def _plain_pixels(path: Path, text: bytes) -> NDArray[np.int64]:
    words = re.sub(rb"#[^\r\n]*", b" ", text).split()
    try:
        pixels = np.array(words, dtype="S8").astype(np.int64)
    except ValueError as error:
        raise DataError(f"{path}: {error}, expected pixels as numbers") from error
    if len(pixels) and int(pixels.min()) < 0:
        raise DataError(f"{path}: a pixel is {pixels.min()}, expected at least 0")
    return pixels


def _decode(path: Path, content: bytes) -> tuple[NDArray[Any], int]:
    import cv2  # large, and not every program has pictures

    try:
        image = (
            cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
            if content
            else None
        )
    except cv2.error as error:
        raise DataError(f"{path} cannot be decoded: {error.err}") from error
    if image is None:
        raise DataError(f"{path} ({len(content)} bytes) is no complete PGM, PNG or BMP image")
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path} has pixels of type {image.dtype}, expected 8 or 16 bits")
    _check_size(path, image.shape[1], image.shape[0])
    return image, int(np.iinfo(image.dtype).max)
