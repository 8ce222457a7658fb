"""Maps on disk, as map_server writes and reads them: a YAML file that names an image.

Image rows run from the top, grid rows from the lowest y: this module alone flips them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap, strips_of
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.maps.image import read_image
from uw_dslam_ros2.io.maps.png import png_parts
from uw_dslam_ros2.io.maps.yaml import MapHeader

__all__ = ["read_map", "write_map"]

MapMode = Literal["trinary", "raw"]

_OCCUPIED_THRESH = 0.65
_FREE_THRESH = 0.196
_PIXEL_OCCUPIED, _PIXEL_FREE, _PIXEL_UNKNOWN = 0, 254, 205
_RAW_UNKNOWN = 255
_LEAST_OF_THREE_GREYS = 0.95  # of a saver's map that somebody has drawn in
_PERCENT = np.append(np.arange(OCCUPIED + 1), UNKNOWN)
_SHADES = np.where(_PERCENT < 0, _PIXEL_UNKNOWN, np.rint(254.0 * (1.0 - _PERCENT / 100.0))).astype(
    np.uint8
)
"""Grey of each value; that of -1 is the last."""
_PIXELS = {
    "trinary": np.select(
        [_PERCENT > 50, (_PERCENT >= 0) & (_PERCENT < 50)],
        [_PIXEL_OCCUPIED, _PIXEL_FREE],
        _PIXEL_UNKNOWN,
    ).astype(np.uint8),
    "raw": np.where(_PERCENT < 0, _RAW_UNKNOWN, _PERCENT).astype(np.uint8),
}
"""Pixel of each value, by mode."""


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
    if mode not in _PIXELS:
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
    contents: dict[Path, bytes | Iterable[bytes]] = {
        pgm_path: _pgm_parts(occupancy, _PIXELS[mode]),
        png_path: png_parts(occupancy.spec.shape, _looked_up(occupancy, _SHADES)),
        yaml_path: text.encode(),
    }
    return write_files(contents)


def read_map(
    yaml_path: str | Path, on_warning: Callable[[str], None] | None = None
) -> OccupancyMap:
    """Read a map_server map (modes trinary, scale and raw; PGM, PNG or BMP image).

    Trinary gives 0, 100 and -1; scale spreads the range between the thresholds over 0..100, and
    takes transparent pixels as unknown; raw takes pixels 0..100 as they are and the others as
    unknown.

    Parameters
    ----------
    yaml_path
        The YAML file. Everything that nav2's map_server takes is taken: modes in any case, numbers
        in quotes, words for `negate`, tabs, more documents, and comments in any encoding. But grey
        205 beside black and white alone is unknown, also where `free_thresh` makes it free.
    on_warning
        Is told in a sentence what can be read, but was probably not meant.

    Raises
    ------
    DataError
        Naming the file, the key, its value, and what was expected; also, before it is decoded,
        for an image of more than 20,000 pixels a side.
    """
    path = Path(yaml_path)
    header = MapHeader.read(path)
    image, white = read_image(_found(header.image_path, path))
    total, num_channels, is_opaque = _sums_of(image, average_alpha=header.mode == "trinary")
    # A table of all sums of channels that there can be, instead of arithmetic for each pixel.
    table = _values_of(np.arange(num_channels * white + 1) / (num_channels * white), header)
    grey = _free_unknown_grey(header, len(table) - 1)
    if grey is not None and (num := int(np.count_nonzero(total == grey))):
        is_saved = header.mode == "trinary" and _has_three_greys(total, len(table) - 1)
        if is_saved:
            table[grey] = UNKNOWN
        if on_warning is not None:
            on_warning(
                f"{path}: free_thresh is {header.free_thresh}, which makes the {num} pixels of "
                f"grey {_PIXEL_UNKNOWN} free, but that is what map savers write for unknown; "
                + (
                    "as the others are black and white, they are read as unknown; write "
                    if is_saved
                    else "they are read as free; if they are unknown, write "
                )
                + f"free_thresh: {_FREE_THRESH}"
            )
    values = table[total]
    if header.mode == "scale" and is_opaque is not None:
        values[~is_opaque] = UNKNOWN
    grid = np.ascontiguousarray(np.flipud(values))
    spec = GridSpec(header.resolution_m, grid.shape[0], grid.shape[1], header.T_frame_grid)
    return OccupancyMap(spec, grid)


def _found(image_path: Path, yaml_path: Path) -> Path:
    """The image's path; where nothing is there, say what lies beside the YAML file."""
    beside = yaml_path.parent / image_path.name
    if beside != image_path and not image_path.exists() and beside.is_file():
        raise DataError(
            f"{yaml_path}: image is {str(image_path)!r}, where there is no file, expected its "
            f"path; {image_path.name} lies beside the YAML file"
        )
    return image_path


def _values_of(shade: NDArray[np.float64], header: MapHeader) -> NDArray[np.int8]:
    """Cells for brightnesses in [0, 1], as map_server decides them."""
    if header.mode == "raw":
        percent = np.floor(shade * 255.0 + 0.5)
        return np.where(percent <= OCCUPIED, percent, UNKNOWN).astype(np.int8)
    probability = shade if header.negate else 1.0 - shade
    low, high = header.free_thresh, header.occupied_thresh
    if header.mode == "scale":
        between = np.rint(100.0 * np.clip((probability - low) / (high - low), 0.0, 1.0))
    else:
        between = np.full(probability.shape, float(UNKNOWN))
    values = np.where(probability > high, OCCUPIED, np.where(probability < low, FREE, between))
    return values.astype(np.int8)


def _sums_of(
    image: NDArray[Any], *, average_alpha: bool
) -> tuple[NDArray[np.uint32], int, NDArray[np.bool_] | None]:
    """Sums over channels (R, C), of how many channels, and where the image is opaque if it tells.

    map_server averages colours, and in trinary mode alpha (greatest: opaque) with them.
    """
    if image.ndim == 2:
        return image.astype(np.uint32), 1, None
    has_alpha = image.shape[2] == 4
    is_opaque = image[:, :, 3] == np.iinfo(image.dtype).max if has_alpha else None
    channels = image if has_alpha and average_alpha else image[:, :, :3]
    return channels.sum(axis=2, dtype=np.uint32), channels.shape[2], is_opaque


def _free_unknown_grey(header: MapHeader, white: int) -> int | None:
    """Sum of channels of the grey that savers write for unknown, where that is free by rule.

    nav2's map saver used to write both that grey and a threshold that makes it free
    (ros-navigation/navigation2, pull request 5278, mended in June 2025).
    """
    is_free = header.free_thresh > 1.0 - _PIXEL_UNKNOWN / 255.0
    grey, rest = divmod(_PIXEL_UNKNOWN * white, 255)
    if header.mode == "raw" or header.negate or not is_free or rest:
        return None
    return grey


def _has_three_greys(total: NDArray[np.uint32], white: int) -> bool:
    """Whether nearly all is black, white, or a saver's grey, and white is there."""
    greys = np.array([_PIXEL_OCCUPIED, _PIXEL_UNKNOWN, _PIXEL_FREE, 255]) * white // 255
    count = [np.count_nonzero(total == grey) for grey in greys]
    return bool(sum(count[2:]) > 0 and sum(count) >= _LEAST_OF_THREE_GREYS * total.size)


def _looked_up(occupancy: OccupancyMap, table: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    """Rows of a picture from the top, in parts; in `_SHADES` white is free, black occupied."""
    for strip in reversed(strips_of(occupancy.spec.num_rows)):
        yield np.flipud(table[occupancy.values[strip.rows]])


def _pgm_parts(occupancy: OccupancyMap, table: NDArray[np.uint8]) -> Iterator[bytes]:
    num_rows, num_cols = occupancy.spec.shape
    yield f"P5\n{num_cols} {num_rows}\n255\n".encode()
    for rows in _looked_up(occupancy, table):
        yield rows.tobytes()
