"""The path within a submap, as few knots as say where the vehicle was."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.se2 import wrap_angle

__all__ = ["read_path", "write_path"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STEPS = np.array([0.02, 0.02, 2.0 * math.pi / 256])  # of x, y [m] and yaw [rad]
_TOLERANCES = np.array([0.08, 0.08, 0.08])
_STAMP_NS = 1_000_000
_TENTH_NS = 100_000_000
_EVERY_NS = 1_000_000_000
_MOST_KNOTS = 60  # written; a path that jumps to and fro is smoothed
_MAX_KNOTS = 255
_MAX_TENTHS = 24 * 36_000  # of one submap
_MAX_STAMP = 2**62 // _STAMP_NS
_WIDTH_BITS = 5  # that say how many bits a column takes


def write_path(writer: ByteWriter, stamps_ns: IntArray, poses: FloatArray) -> None:
    """Write stamps (K,), increasing, and poses (K, 3) [x, y, yaw], thinned.

    Knots are added where the curve through them is farthest off, until it is nowhere more than
    0.08 m (a coordinate) and 0.08 rad off; then they are moved so that it fits best in all.
    """
    if len(poses) == 0:
        writer.varint(0)
        return
    first = int(stamps_ns[0]) // _STAMP_NS
    tenths = (stamps_ns - first * _STAMP_NS) / _TENTH_NS
    whole = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    rows = np.column_stack([np.rint(tenths), np.rint(whole / _STEPS)]).astype(np.int64)
    chosen = _fitted(tenths, whole, rows[_knots(tenths, whole, rows)])
    chosen[:, 0] = np.minimum(chosen[:, 0], _MAX_TENTHS)
    steps = np.diff(chosen, axis=0, prepend=np.zeros((1, 4), np.int64))
    # Signs to the lowest bit, so that small steps of either sign are small numbers.
    steps[:, 1:] = np.where(steps[:, 1:] < 0, -2 * steps[:, 1:] - 1, 2 * steps[:, 1:])
    widths = [int(value).bit_length() for value in steps.max(axis=0)]
    if max(widths) >= 1 << _WIDTH_BITS:
        raise InvalidInputError(
            f"the path has a step of {max(widths)} bits, expected less than 32"
        )
    bits, num_bits = 0, 0
    for values, sizes in ((widths, [_WIDTH_BITS] * 4), *((row, widths) for row in steps.tolist())):
        for value, size in zip(values, sizes, strict=True):
            bits, num_bits = bits << size | value, num_bits + size
    writer.varint(len(steps))
    writer.varint(first)
    writer.raw((bits << -num_bits % 8).to_bytes(-(-num_bits // 8), "big"))


def read_path(reader: ByteReader) -> tuple[IntArray, FloatArray]:
    """Stamps (K,) [ns] and poses (K, 3) of a path: at its knots, and each second between."""
    num_knots = reader.bounded("the number of knots of the path", 0, _MAX_KNOTS)
    if num_knots == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    first_ns = reader.bounded("the stamp where the path begins [ms]", 0, _MAX_STAMP) * _STAMP_NS
    head = reader.raw(3)
    widths = [int.from_bytes(head, "big") >> shift & 31 for shift in (19, 14, 9, 4)]
    total = 4 * _WIDTH_BITS + num_knots * sum(widths)
    bits = int.from_bytes(head + reader.raw(max(0, -(-total // 8) - 3)), "big") >> -total % 8
    steps, left = np.zeros((num_knots, 4), np.int64), total - 4 * _WIDTH_BITS
    for index in range(num_knots):
        for column, width in enumerate(widths):
            left -= width
            steps[index, column] = bits >> left & (1 << width) - 1
    signed = steps[:, 1:]
    steps[:, 1:] = np.where(signed % 2 == 1, -(signed + 1) // 2, signed // 2)
    rows = np.cumsum(steps, axis=0)
    if rows[-1, 0] > _MAX_TENTHS:
        raise InvalidInputError(
            f"the path takes {rows[-1, 0] / 10:g} s, expected at most {_MAX_TENTHS / 10:g} s"
        )
    every = np.arange(0, int(rows[-1, 0]) * _TENTH_NS, _EVERY_NS)
    since_ns = np.unique(np.concatenate([every, rows[:, 0] * _TENTH_NS]))
    poses = _curve(since_ns / _TENTH_NS, rows)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return first_ns + since_ns, poses


def _knots(tenths: FloatArray, poses: FloatArray, rows: IntArray) -> list[int]:
    chosen = sorted({0, len(poses) - 1})
    group = np.unique(rows[:, 0], return_inverse=True)[1]
    is_knot = np.zeros(len(poses), bool)  # of groups of equal time
    for _ in range(_MOST_KNOTS - 2):
        off = (np.abs(_curve(tenths, rows[chosen]) - poses) / _TOLERANCES).max(axis=1)
        is_knot[group[chosen]] = True
        off[is_knot[group]] = 0.0
        worst = int(np.argmax(off))
        if off[worst] <= 1.0:
            break
        chosen = sorted({*chosen, worst})
    return chosen


def _fitted(tenths: FloatArray, poses: FloatArray, knots: IntArray) -> IntArray:
    """Knots [0.1 s, steps] at the same times, moved to where the squares of errors are least."""
    time = np.unique(knots[:, 0])
    # The curve is a weighted sum of its knots, the same for each coordinate.
    weights = np.empty((len(tenths), len(time)))
    for index in range(len(time)):
        one = np.zeros((len(time), 4))
        one[:, 0] = time
        one[index, 1:] = 1.0 / _STEPS
        weights[:, index] = _curve(tenths, one)[:, 0]
    best = np.linalg.lstsq(weights, poses, rcond=None)[0]
    return np.column_stack([time, np.rint(best / _STEPS)]).astype(np.int64)


def _curve(tenths: FloatArray, rows: IntArray | FloatArray) -> FloatArray:
    """Poses at times [0.1 s], on a cubic curve through knots [0.1 s, steps] of increasing time.

    It passes each knot in the direction from the one before to the one after.
    """
    time, index = np.unique(rows[:, 0], return_index=True)
    knots = rows[index, 1:] * _STEPS
    if len(time) == 1:
        return np.repeat(knots, len(tenths), axis=0)
    last = len(time) - 1
    before, after = (
        np.clip(np.arange(last + 1) - 1, 0, None),
        np.minimum(np.arange(last + 1) + 1, last),
    )
    slopes = (knots[after] - knots[before]) / (time[after] - time[before])[:, None]
    i = np.clip(np.searchsorted(time, tenths, side="right") - 1, 0, last - 1)
    length = (time[i + 1] - time[i])[:, None]
    s = np.clip((tenths - time[i])[:, None] / length, 0.0, 1.0)
    rest = 1.0 - s
    ends = (1.0 + 2.0 * s) * rest * rest * knots[i] + (3.0 - 2.0 * s) * s * s * knots[i + 1]
    return ends + length * s * rest * (rest * slopes[i] - s * slopes[i + 1])
