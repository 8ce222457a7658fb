"""Maps on disk, as map_server writes and reads them: a YAML file that names an image.

Image rows run from the top, grid rows from the lowest y: this module alone flips them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.atomic import write_files

__all__ = ["image_of", "read_map", "write_map"]

MapMode = Literal["trinary", "raw"]

_OCCUPIED_THRESH = 0.65
_FREE_THRESH = 0.196
_PIXEL_OCCUPIED, _PIXEL_FREE, _PIXEL_UNKNOWN = 0, 254, 205
_RAW_UNKNOWN = 255
_MAX_CELLS = 2**30


def image_of(occupancy: OccupancyMap) -> NDArray[np.uint8]:
    """Picture (R, C), first row on top: white is free, black occupied, 205 unknown."""
    shade = np.rint(254.0 * (1.0 - occupancy.values / 100.0)).astype(np.uint8)
    return np.flipud(np.where(occupancy.known, shade, np.uint8(_PIXEL_UNKNOWN)))


def write_map(
    path_prefix: str | Path, occupancy: OccupancyMap, *, mode: MapMode = "trinary"
) -> list[Path]:
    """Write ``PREFIX.pgm``, ``PREFIX.png`` (for looking at) and ``PREFIX.yaml``; return the paths.

    Missing folders are made; existing files are replaced whole or not at all.

    Parameters
    ----------
    path_prefix
        Path without ending.
    occupancy
        The map; a rotated origin goes into the YAML file's yaw.
    mode
        "trinary" keeps the decision: cells above 50 percent are written as occupied, known ones
        below as free, exactly 50 as unknown. (map_server's own saver drops what lies between its
        thresholds, so a cell of 26 to 64 percent would be lost.) "raw" keeps every percentage.

    Raises
    ------
    DataError
        With the path and the reason.
    """
    prefix = Path(path_prefix)
    yaml_path, pgm_path, png_path = (
        prefix.with_name(prefix.name + end) for end in (".yaml", ".pgm", ".png")
    )
    if mode == "trinary":
        pixels = _trinary_pixels(occupancy)
    elif mode == "raw":
        pixels = np.where(occupancy.known, occupancy.values.view(np.uint8), np.uint8(_RAW_UNKNOWN))
    else:
        raise InvalidInputError(f"mode is {mode!r}, expected 'trinary' or 'raw'")
    origin = occupancy.spec.T_frame_grid
    description = {
        "image": pgm_path.name,
        "mode": mode,
        "resolution": float(occupancy.spec.resolution_m),
        "origin": [origin.x, origin.y, origin.yaw],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESH,
        "free_thresh": _FREE_THRESH,
    }
    text = yaml.safe_dump(
        description, sort_keys=False, default_flow_style=None, allow_unicode=True
    )
    contents = {
        pgm_path: _pgm_bytes(np.flipud(pixels)),
        png_path: _png_bytes(image_of(occupancy)),
        yaml_path: text.encode(),
    }
    return write_files(contents)


def read_map(yaml_path: str | Path) -> OccupancyMap:
    """Read a map_server map (modes trinary, scale and raw; PGM, PNG or BMP image).

    Trinary gives 0, 100 and -1; scale spreads the range between the thresholds over 0..100, and
    takes transparent pixels as unknown; raw takes pixels 0..100 as they are and the others as
    unknown.

    Raises
    ------
    DataError
        Naming the file, the key, its value, and what was expected.
    """
    path = Path(yaml_path)
    header = _MapHeader.read(path)
    image = _read_image(header.image_path)
    shade, is_opaque = _shade_of(image, average_alpha=header.mode == "trinary")
    if header.mode == "raw":
        percent = np.rint(shade * 255.0)
        values = np.where(percent <= OCCUPIED, percent, UNKNOWN)
    else:
        probability = shade if header.negate else 1.0 - shade
        low, high = header.free_thresh, header.occupied_thresh
        if header.mode == "scale":
            between = np.rint(100.0 * np.clip((probability - low) / (high - low), 0.0, 1.0))
        else:
            between = np.full(probability.shape, float(UNKNOWN))
        values = np.where(probability > high, OCCUPIED, np.where(probability < low, FREE, between))
        if header.mode == "scale":
            values = np.where(is_opaque, values, UNKNOWN)
    grid = np.ascontiguousarray(np.flipud(values)).astype(np.int8)
    spec = GridSpec(header.resolution_m, grid.shape[0], grid.shape[1], header.T_frame_grid)
    return OccupancyMap(spec, grid)


def _trinary_pixels(occupancy: OccupancyMap) -> NDArray[np.uint8]:
    pixels = np.full(occupancy.spec.shape, _PIXEL_UNKNOWN, dtype=np.uint8)
    pixels[occupancy.values > 50] = _PIXEL_OCCUPIED
    pixels[occupancy.known & (occupancy.values < 50)] = _PIXEL_FREE
    return pixels


def _pgm_bytes(pixels: NDArray[np.uint8]) -> bytes:
    header = f"P5\n{pixels.shape[1]} {pixels.shape[0]}\n255\n"
    return header.encode() + np.ascontiguousarray(pixels).tobytes()


def _png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    is_done, buffer = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not is_done:
        raise DataError(f"cannot encode a {pixels.shape[1]} x {pixels.shape[0]} picture as PNG")
    return buffer.tobytes()


@dataclass(frozen=True, slots=True)
class _MapHeader:
    """The YAML file, checked."""

    image_path: Path
    mode: str
    resolution_m: float
    T_frame_grid: SE2
    negate: bool
    occupied_thresh: float
    free_thresh: float

    @classmethod
    def read(cls, path: Path) -> _MapHeader:
        """From a map_server YAML file; raises `DataError` naming file, key and value."""
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise DataError(f"cannot read {path}: {error.strerror or error}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise DataError(
                f"{path} is not a YAML file: {' '.join(str(error).split())}"
            ) from error
        if not isinstance(content, dict):
            raise DataError(
                f"{path} holds a {type(content).__name__}, expected keys such as image"
            )
        mode = content.get("mode", "trinary")
        if mode not in ("trinary", "scale", "raw"):
            raise DataError(f"{path}: mode is {mode!r}, expected trinary, scale or raw")
        image = content.get("image")
        if not isinstance(image, str) or not image:
            raise DataError(f"{path}: image is {image!r}, expected the name of a file")
        resolution_m = _number(path, content, "resolution")
        if resolution_m <= 0.0:
            raise DataError(f"{path}: resolution is {resolution_m}, expected metres per cell > 0")
        occupied_thresh, free_thresh = (
            _number(path, content, f"{k}_thresh") for k in ("occupied", "free")
        )
        if not 0.0 <= free_thresh < occupied_thresh <= 1.0:
            raise DataError(
                f"{path}: free_thresh is {free_thresh} and occupied_thresh {occupied_thresh}, "
                "expected 0 <= free_thresh < occupied_thresh <= 1"
            )
        negate = content.get("negate", 0)
        if negate not in (0, 1, False, True):
            raise DataError(f"{path}: negate is {negate!r}, expected 0 or 1")
        T_frame_grid = _origin(path, content)
        return cls(
            path.parent / image,
            mode,
            resolution_m,
            T_frame_grid,
            bool(negate),
            occupied_thresh,
            free_thresh,
        )


def _number(path: Path, content: dict[str, Any], key: str) -> float:
    value: Any = content.get(key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value):
        raise DataError(f"{path}: {key} is {value!r}, expected a finite number")
    return float(value)


def _origin(path: Path, content: dict[str, Any]) -> SE2:
    origin: Any = content.get("origin")
    is_numbers = isinstance(origin, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in origin
    )
    if not is_numbers or len(origin) != 3:
        raise DataError(
            f"{path}: origin is {origin!r}, expected [x, y, yaw] in metres and radians"
        )
    return SE2(*(float(v) for v in origin))


def _read_image(path: Path) -> NDArray[Any]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    if content[:2] == b"P5":
        _check_pgm_size(path, content)
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
    return image


def _check_pgm_size(path: Path, content: bytes) -> None:
    """Refuse a truncated file: the decoder fills it up with black, that is with walls."""
    tokens: list[int] = []
    position = 2
    while len(tokens) < 3 and position < len(content):
        if content[position : position + 1] == b"#":
            end = content.find(b"\n", position)
            position = len(content) if end < 0 else end
        elif content[position : position + 1].isdigit():
            end = position
            while content[end : end + 1].isdigit():
                end += 1
            tokens.append(int(content[position:end]))
            position = end
        else:
            position += 1
    if len(tokens) < 3 or min(tokens) < 1 or tokens[2] > 65535:
        raise DataError(
            f"{path}: the PGM header is broken, expected width, height and largest value"
        )
    width, height, largest = tokens
    if width * height > _MAX_CELLS:
        raise DataError(
            f"{path}: the image has {width} x {height} pixels, expected at most {_MAX_CELLS}"
        )
    expected = width * height * (2 if largest > 255 else 1)
    if len(content) - position - 1 < expected:
        raise DataError(
            f"{path} is truncated: {len(content) - position - 1} bytes of pixels, "
            f"expected {expected}"
        )


def _shade_of(
    image: NDArray[Any], *, average_alpha: bool
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Brightness in [0, 1], and where the image is opaque.

    map_server averages colours, and in trinary mode alpha (255 opaque) with them.
    """
    scaled = image.astype(np.float64) / np.iinfo(image.dtype).max
    if scaled.ndim == 2:
        return scaled, np.ones(scaled.shape, dtype=np.bool_)
    has_alpha = scaled.shape[2] == 4
    is_opaque = scaled[:, :, 3] >= 1.0 if has_alpha else np.ones(scaled.shape[:2], dtype=np.bool_)
    channels = scaled if has_alpha and average_alpha else scaled[:, :, :3]
    return channels.mean(axis=2), is_opaque
