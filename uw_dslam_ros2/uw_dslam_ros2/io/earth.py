"""Coordinates on earth: UTM of latitude and longitude, and pictures of maps that GIS read."""

from __future__ import annotations

import io
import math
import re

import numpy as np
from PIL import Image, TiffImagePlugin

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["geotiff_bytes", "projection_bytes", "utm_frame", "utm_position", "world_file_bytes"]

_UTM = re.compile(r"EPSG:32([67])(\d\d)")
_EPSG = re.compile(r"EPSG:(\d{4,5})")
_UTM_WKT = (
    'PROJCS["WGS 84 / UTM zone {name}",GEOGCS["WGS 84",DATUM["WGS_1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",{meridian}],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",{northing}],UNIT["metre",1]]'
)
_AXIS_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563  # WGS 84
_SCALE, _EAST_M, _NORTH_M = 0.9996, 500_000.0, 10_000_000.0
_UNKNOWN = 255
_TRANSFORMATION, _KEYS, _TEXTS, _NO_DATA = 34264, 34735, 34737, 42113
"""Tags of GeoTIFF 1.1 (OGC 19-008), and GDAL's for cells that are not known."""
_USER_DEFINED = 32767


def utm_frame(latitude_deg: float, longitude_deg: float) -> str:
    """Name of the UTM zone that a place lies in, such as ``EPSG:32632``."""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    return f"EPSG:32{6 if latitude_deg >= 0.0 else 7}{zone:02d}"


def utm_position(latitude_deg: float, longitude_deg: float, frame: str) -> tuple[float, float]:
    """East and north [m] in a UTM zone, that of the place or a neighbour.

    Raises
    ------
    InvalidInputError
        If the frame is no UTM zone.

    Notes
    -----
    Krueger's series to the third order, Karney 2011 (eq. 7 to 11, 35): to less than a millimetre.
    """
    zone, is_south = _zone(frame)
    n = _FLATTENING / (2.0 - _FLATTENING)
    alphas = (
        n / 2.0 - 2.0 * n**2 / 3.0 + 5.0 * n**3 / 16.0,
        13.0 * n**2 / 48.0 - 3.0 * n**3 / 5.0,
        61.0 * n**3 / 240.0,
    )
    radius_m = _AXIS_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    eccentricity = 2.0 * math.sqrt(n) / (1.0 + n)
    sine = math.sin(math.radians(latitude_deg))
    t = math.sinh(math.atanh(sine) - eccentricity * math.atanh(eccentricity * sine))
    turn = math.radians((longitude_deg - _meridian(zone) + 180.0) % 360.0 - 180.0)
    xi = math.atan2(t, math.cos(turn))
    eta = math.asinh(math.sin(turn) / math.hypot(t, math.cos(turn)))
    east, north = eta, xi
    for j, alpha in enumerate(alphas, start=1):
        east += alpha * math.cos(2 * j * xi) * math.sinh(2 * j * eta)
        north += alpha * math.sin(2 * j * xi) * math.cosh(2 * j * eta)
    shift_m = _NORTH_M if is_south else 0.0
    return _EAST_M + _SCALE * radius_m * east, shift_m + _SCALE * radius_m * north


def world_file_bytes(spec: GridSpec, T_earth_map: SE2) -> bytes:
    """Six numbers: what a step right and a step down are, and where the first pixel lies."""
    c, s, x_m, y_m = _affine(spec, T_earth_map, 0.5)
    return "".join(f"{value:.9f}\n" for value in (c, s, s, -c, x_m, y_m)).encode()


def projection_bytes(frame: str) -> bytes | None:
    """Coordinates as text for the file beside a world file; None where they are not UTM."""
    if not _UTM.fullmatch(frame):
        return None
    zone, is_south = _zone(frame)
    return _UTM_WKT.format(
        name=f"{zone}{'S' if is_south else 'N'}",
        meridian=_meridian(zone),
        northing=int(_NORTH_M) if is_south else 0,
    ).encode()


def geotiff_bytes(occupancy: OccupancyMap, T_earth_map: SE2, frame: str) -> bytes:
    """A picture that knows where it lies: per cent occupied, 255 where nothing is known.

    `frame` is named by its number where it is ``EPSG:...``, else as text.
    """
    spec = occupancy.spec
    c, s, x_m, y_m = _affine(spec, T_earth_map, 0.0)
    known = _EPSG.fullmatch(frame)
    code = int(known[1]) if known else _USER_DEFINED
    text = f"{frame}|".encode("ascii", "replace").decode()
    # Of each key: its number, where its value is (0: here), how many values, and the value.
    keys = [(1024, 0, 1, 1), (1025, 0, 1, 1), (1026, _TEXTS, len(text), 0), (3072, 0, 1, code)]
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype |= {_TRANSFORMATION: 12, _KEYS: 3, _TEXTS: 2, _NO_DATA: 2}
    tags[_TRANSFORMATION] = (c, s, 0.0, x_m, s, -c, 0.0, y_m, *[0.0] * 7, 1.0)
    tags[_KEYS] = (1, 1, 0, len(keys), *(value for key in keys for value in key))
    tags[_TEXTS], tags[_NO_DATA] = text, str(_UNKNOWN)
    values = occupancy.values.view(np.uint8)  # -1, which is not known, becomes 255
    buffer = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(values[::-1]))
    picture.save(buffer, "TIFF", tiffinfo=tags, compression="tiff_adobe_deflate")
    return buffer.getvalue()


def _affine(spec: GridSpec, T_earth_map: SE2, at: float) -> tuple[float, float, float, float]:
    """A step right on earth, and the place of the first pixel: its corner at 0, middle at 0.5."""
    T_earth_grid = T_earth_map @ spec.T_frame_grid
    c = spec.resolution_m * math.cos(T_earth_grid.yaw)
    s = spec.resolution_m * math.sin(T_earth_grid.yaw)
    # Pictures begin with the last row, at its far side.
    first = np.array([[at, spec.num_rows - at]]) * spec.resolution_m
    x_m, y_m = T_earth_grid.apply(first)[0].tolist()
    return c, s, x_m, y_m


def _zone(frame: str) -> tuple[int, bool]:
    found = _UTM.fullmatch(frame)
    if found is None or not 1 <= int(found[2]) <= 60:
        raise InvalidInputError(f"frame is {frame!r}, expected a UTM zone such as EPSG:32632")
    return int(found[2]), found[1] == "7"


def _meridian(zone: int) -> int:
    return 6 * zone - 183
