"""``sensor_msgs``: PointCloud2 (echoes, perhaps each with its time) and PointCloud (Micron)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar import SonarImage
from uw_dslam_ros2.core.sonar.turning import is_few_beams
from uw_dslam_ros2.io.drivers.adapter import Adapter, as_bytes, key_of, stamp_of
from uw_dslam_ros2.io.drivers.laser_scan import ONE_MOMENT_S
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import BeamsEvent, ImageEvent, PointsEvent

__all__ = ["ADAPTERS", "read_cloud", "read_old_cloud"]

FloatArray = NDArray[np.float64]
_Read = PointsEvent | BeamsEvent | ImageEvent

# By the constants of PointField.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_STAMP_FIELDS = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "stamp",
    "time_offset",
    "offset_time",
    "t_offset",
)
_INTENSITIES = ("intensity", "intensities", "i", "amplitude", "power", "strength")
_MIN_BINS = 8
_SAME_BEARING_RAD = 1e-3
_DAY_S = 86400.0
_LONGEST_TURN_S = 60.0


def read_cloud(msg: Any, settings: ReadSettings) -> Sequence[_Read]:
    """Echoes of one moment, in the plane or in space; or bins of beams, each with an intensity.

    With a field of times (from the stamp, or absolute) that span more than a moment, those near
    the frame's plane are beams of a sonar that turns.
    """
    cells, fields, order = _cells(msg)
    names = ("x", "y", "z") if "z" in fields else ("x", "y")
    points = np.column_stack([_column(cells, fields, order, name) for name in names])
    if (channel := next((n for n in _INTENSITIES if n in fields), None)) is not None:
        values = _column(cells, fields, order, channel)
        if (event := _of_bins(msg, settings, points, values)) is not None:
            return (event,)
    is_used = np.isfinite(points).all(axis=1)
    offset_s = _offsets(cells, fields, order, stamp_of(msg))
    if offset_s is not None and is_used.any():
        if not np.isfinite(offset_s[is_used]).all():
            raise InvalidInputError("the field of times holds values that are not finite")
        if float(np.ptp(offset_s[is_used])) >= ONE_MOMENT_S:
            if points.shape[1] == 3:
                is_used &= np.abs(points[:, 2]) <= settings.point_max_height_m
            return (_beams(msg, settings, points[is_used], offset_s[is_used]),)
    return (_points(msg, settings, points[is_used]),)


def _points(msg: Any, settings: ReadSettings, points: FloatArray) -> PointsEvent:
    """Points (N, 2) or (N, 3); flat ones lie in a fan."""
    is_flat = points.shape[1] == 2 or not points[:, 2].any()
    key = key_of(msg, settings)
    if is_flat:
        return PointsEvent(*key, np.ascontiguousarray(points[:, :2]))
    return PointsEvent(*key, points, settings.point_max_height_m)


def _cells(msg: Any) -> tuple[NDArray[np.uint8], dict[str, Any], str]:
    """Points (N, point_step) as bytes, the fields by name, the byte order."""
    num_rows, num_cols = int(msg.height), int(msg.width)
    point_step, row_step = int(msg.point_step), int(msg.row_step)
    data = as_bytes(msg.data, "data")
    if len(data) != num_rows * row_step or row_step < num_cols * point_step:
        raise InvalidInputError(
            f"data has {len(data)} bytes, expected height x row_step = {num_rows} x {row_step}, "
            f"each row holding width x point_step = {num_cols} x {point_step}"
        )
    rows = data.reshape(num_rows, row_step)[:, : num_cols * point_step]
    cells = np.ascontiguousarray(rows).reshape(num_rows * num_cols, point_step)
    return cells, {f.name: f for f in msg.fields}, ">" if msg.is_bigendian else "<"


def _column(cells: NDArray[np.uint8], fields: dict[str, Any], order: str, name: str) -> FloatArray:
    if name not in fields or int(fields[name].datatype) not in _POINT_TYPES:
        raise InvalidInputError(f"no field {name!r} of a known type; there are {sorted(fields)}")
    dtype = np.dtype(order + _POINT_TYPES[int(fields[name].datatype)])
    offset, point_step = int(fields[name].offset), cells.shape[1]
    if offset + dtype.itemsize > point_step:
        raise InvalidInputError(
            f"field {name!r} at offset {offset} exceeds point_step {point_step}"
        )
    chunk = np.ascontiguousarray(cells[:, offset : offset + dtype.itemsize])
    return np.asarray(chunk.view(dtype).reshape(-1), np.float64)


def _offsets(
    cells: NDArray[np.uint8], fields: dict[str, Any], order: str, stamp_ns: int
) -> FloatArray | None:
    """Time of each point after the message's stamp [s]; None without such a field.

    Integers are nanoseconds, reals seconds, or nanoseconds where they span too much for seconds.
    """
    name = next((n for n in _STAMP_FIELDS if n in fields), None)
    if name is None or len(cells) == 0:
        return None
    values, kind, stamp_s = (
        _column(cells, fields, order, name),
        fields[name].datatype,
        stamp_ns / 1e9,
    )
    known = values[np.isfinite(values)]
    if int(kind) not in (7, 8):
        return values * 1e-9
    if not len(known):
        return values
    middle = float(np.median(known))
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        if middle * unit > _DAY_S and abs(middle * unit - stamp_s) < _DAY_S:
            if kind == 7:
                return None  # seconds of an epoch in 32 bits are minutes apart
            offset_s = values * unit - stamp_s
            # The stamp was put on another clock, or is of another: the first point's then.
            is_apart = np.abs(known * unit - stamp_s).min() > _LONGEST_TURN_S
            return offset_s - float(np.nanmin(offset_s)) if is_apart else offset_s
    return values * 1e-9 if float(np.ptp(known)) > 10.0 * _LONGEST_TURN_S else values


def _beams(
    msg: Any, settings: ReadSettings, points: FloatArray, offset_s: FloatArray
) -> BeamsEvent | PointsEvent:
    stamps = stamp_of(msg) + np.round(offset_s * 1e9).astype(np.int64)
    order = np.argsort(stamps, kind="stable")
    if len(order) == 0:
        return _points(msg, settings, points)
    ranges = np.hypot(points[order, 0], points[order, 1])
    vehicle_id, _, frame_id = key_of(msg, settings)
    return BeamsEvent(
        vehicle_id,
        int(stamps[order[0]]),
        frame_id,
        stamps[order],
        np.arctan2(points[order, 1], points[order, 0]),
        ranges,
        # Nothing is said of beams without an echo; every range here is one.
        float(np.nextafter(ranges.max(), np.inf)),
    )


def read_old_cloud(msg: Any, settings: ReadSettings) -> Sequence[_Read]:
    """Read a ``PointCloud``: bins of one beam or sector with a channel of intensities, or echoes.

    Drivers of Tritech's Micron send one message per beam, whose points are the bins of range.
    """
    xyz = np.array([(p.x, p.y, p.z) for p in msg.points], dtype=np.float64).reshape(-1, 3)
    if len(xyz) == 0:
        return ()
    channel = next((c for c in msg.channels if c.name in _INTENSITIES), None)
    if channel is not None:
        values = np.asarray(channel.values, dtype=np.float64)
        if len(values) != len(xyz):
            raise InvalidInputError(
                f"channels[{channel.name}] has {len(values)} values, expected one per point "
                f"({len(xyz)})"
            )
        if (event := _of_bins(msg, settings, xyz, values)) is not None:
            return (event,)
    return (_points(msg, settings, xyz[np.isfinite(xyz).all(axis=1)]),)


def _of_bins(
    msg: Any, settings: ReadSettings, points: FloatArray, values: FloatArray
) -> BeamsEvent | ImageEvent | None:
    """Beams of one moment where the points (N, 2 or 3) are bins; a whole fan is an image."""
    if (found := _bins(points, values)) is None:
        return None
    bearing_rad, range_m, intensity = found
    image = SonarImage(stamp_of(msg), intensity, range_m, bearing_rad)
    if not is_few_beams(image):
        return ImageEvent(*key_of(msg, settings), image, "x")
    return BeamsEvent(
        *key_of(msg, settings),
        np.full(len(bearing_rad), stamp_of(msg), np.int64),
        bearing_rad,
        range_m,
        float(range_m[-1] + 0.5 * (range_m[1] - range_m[0])),
        intensity,
    )


def _bins(
    points: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.generic]] | None:
    """Bearings (B,), ranges (R,), intensities (R, B) where the points are bins; else None."""
    if not (len(points) and np.isfinite(points).all() and np.isfinite(values).all()):
        return None
    ranges = np.hypot(points[:, 0], points[:, 1])
    starts = np.flatnonzero(np.concatenate([[True], np.diff(ranges) <= 0.0]))
    num_bins = len(ranges) // len(starts)
    if num_bins < _MIN_BINS or (np.diff(np.append(starts, len(ranges))) != num_bins).any():
        return None
    by_beam = ranges.reshape(-1, num_bins)
    if np.ptp(by_beam, axis=0).max() > 0.01 * by_beam[0, -1]:
        return None
    flat = points[:, :2].reshape(-1, num_bins, 2)
    last = flat[:, -1]
    # How far the bins lie beside the line to their beam's last.
    aside = np.abs(flat[..., 0] * last[:, None, 1] - flat[..., 1] * last[:, None, 0])
    if (aside > _SAME_BEARING_RAD * by_beam[:, -1:] ** 2).any():
        return None
    intensity = values.reshape(-1, num_bins).T
    is_count = values.min() >= 0.0 and 1.0 < values.max() <= 255.0
    return (
        np.arctan2(last[:, 1], last[:, 0]),
        by_beam[0],
        np.round(intensity).astype(np.uint8) if is_count else intensity.astype(np.float32),
    )


ADAPTERS = (
    Adapter("sensor_msgs/msg/PointCloud2", ("sonar",), read_cloud),
    Adapter("sensor_msgs/msg/PointCloud", ("sonar",), read_old_cloud),
)
