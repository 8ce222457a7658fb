"""The signed field of a map: walls positive, free space negative, unknown zero; its bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import CellEvidence
from uw_dslam_ros2.core.registration.grids.kernels import CURVATURE_STEP, TABLE_STEP

__all__ = [
    "PAD",
    "SignedField",
    "curvature_tables",
    "layer_lookup",
    "refined",
    "signed_field",
    "value_tables",
    "wall_distance",
]

FloatGrid = NDArray[np.float32]
TableArray = NDArray[np.int16]

WIDTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32)
"""Windows, in cells, over which the tables hold maxima."""
PAD = WIDTHS[-1]


@dataclass(frozen=True, slots=True, eq=False)
class SignedField:
    """A field on working cells: B-spline coefficients (R + 2 PAD, C + 2 PAD), at most 1."""

    coefficients: FloatGrid


def wall_distance(cells: CellEvidence) -> FloatGrid:
    """Distance (R, C) from cells to the nearest wall, in cells; infinite without any wall."""
    is_wall = cells.wall > 0.25
    if not is_wall.any():
        return np.full(cells.shape, np.inf, np.float32)
    distance: FloatGrid = cv2.distanceTransform(
        (~is_wall).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    # OpenCV's last bit depends on where in memory the array lies. Squares are whole numbers.
    np.multiply(distance, distance, out=distance)
    np.rint(distance, out=distance)
    np.sqrt(distance, out=distance)
    return distance


def signed_field(
    cells: CellEvidence,
    sigma_cells: float,
    free_penalty: float,
    stride: int = 1,
    distance: FloatGrid | None = None,
) -> SignedField:
    """Field of a map's cells, on a lattice ``stride`` times coarser.

    A wall is worth exp(-d^2 / (2 sigma^2)) at distance d, free space -``free_penalty`` times its
    share of the neighbourhood, less as a wall comes near. ``sigma_cells`` is in cells of
    ``cells``; ``distance`` is `wall_distance` where it is known already.
    """
    if distance is None:
        distance = wall_distance(cells)
    free = cv2.boxFilter(cells.free, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)
    # Nothing is known beyond the edge of a map, not even that a wall's kernel reaches there.
    return SignedField(_padded_means(distance, free, sigma_cells, free_penalty, stride, PAD))


@njit(cache=True, nogil=True)
def _padded_means(
    distance: FloatGrid, free: FloatGrid, sigma: float, penalty: float, stride: int, pad: int
) -> FloatGrid:
    """Means of the field over ``stride`` x ``stride`` cells; what is outside counts as zero."""
    num_rows, num_cols = distance.shape
    rows, cols = -(-num_rows // stride), -(-num_cols // stride)
    result = np.zeros((rows + 2 * pad, cols + 2 * pad), np.float32)
    reach, scale = 6.0 * sigma, -0.5 / sigma**2
    for i in range(rows):
        for j in range(cols):
            total = 0.0
            for row in range(i * stride, min((i + 1) * stride, num_rows)):
                for col in range(j * stride, min((j + 1) * stride, num_cols)):
                    d = distance[row, col]
                    if d < reach:
                        near = math.exp(scale * d * d)
                        total += near - penalty * free[row, col] * (1.0 - near)
                    else:  # the kernel is below the precision of the field
                        total -= penalty * free[row, col]
            result[pad + i, pad + j] = total / (stride * stride)
    return result


def layer_lookup() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each width in cells the first table that covers it; and the tables' widths."""
    widths = np.array(WIDTHS, dtype=np.int64)
    return np.searchsorted(widths, np.arange(widths[-1] + 1)).astype(np.int64), widths


def value_tables(field: SignedField) -> TableArray:
    """Upper bounds of a field over windows of `WIDTHS` cells, in `TABLE_STEP`.

    The result is (num_widths, R, C); entry [k, row, col] holds for the cells row..row + width - 1
    and likewise for columns. Within a cell the spline is a polynomial inside the hull of its nine
    Bezier coefficients.
    """
    return _windows(_bezier_max(field.coefficients), TABLE_STEP)


def curvature_tables(field: SignedField) -> TableArray:
    """Upper bounds of the field's curvature [1 / cell^2], in `CURVATURE_STEP`; see `value_tables`.

    Second derivatives are inside the hull of the coefficients' second differences.
    """
    return _windows(_curvature_max(field.coefficients), CURVATURE_STEP)


def refined(field: SignedField) -> SignedField:
    """The same function on a lattice twice as fine, by Chaikin's knot insertion.

    Its cells are the halves of the coarse ones: cells 2 k and 2 k + 1 make up cell k.
    """
    c = field.coefficients
    for axis in (0, 1):
        p = np.pad(c, [(1, 1) if k == axis else (0, 0) for k in (0, 1)])
        before = p[:-2] if axis == 0 else p[:, :-2]
        after = p[2:] if axis == 0 else p[:, 2:]
        near, far = np.float32(0.75), np.float32(0.25)
        pair = np.stack([near * c + far * before, near * c + far * after], axis=axis + 1)
        c = pair.reshape(c.shape[0] * (2 - axis), c.shape[1] * (1 + axis))
    return SignedField(c)


def _windows(base: FloatGrid, step: float) -> TableArray:
    # The margin covers that kernels compute in double precision from single-precision numbers.
    steps = np.ceil((base + np.float32(2e-6)) / np.float32(step)).astype(np.int16)
    tables = np.empty((len(WIDTHS), *base.shape), np.int16)
    for layer, width in enumerate(WIDTHS):
        tables[layer] = cv2.dilate(steps, np.ones((width, width), np.uint8), anchor=(0, 0))
    return tables


def _bezier_max(c: FloatGrid) -> FloatGrid:
    """Maximum over a cell's Bezier coefficients, each a mean of one, two or four coefficients."""
    half = np.float32(0.5)
    best = c.copy()
    p = np.pad(c, 1)
    lines = [p[:, 1:-1], half * (p[:, :-2] + p[:, 1:-1]), half * (p[:, 1:-1] + p[:, 2:])]
    for line in lines:
        np.maximum(best, line[1:-1], out=best)
        np.maximum(best, half * (line[:-2] + line[1:-1]), out=best)
        np.maximum(best, half * (line[1:-1] + line[2:]), out=best)
    return best


def _curvature_max(c: FloatGrid) -> FloatGrid:
    """Bound of the greatest eigenvalue of a cell's Hessian, at least 0."""
    p = np.pad(c, 2)
    inner = np.pad(c, 1)
    xx = p[1:-1, :-2] - np.float32(2.0) * p[1:-1, 1:-1] + p[1:-1, 2:]  # of rows -1..R, cols -1..C
    yy = p[:-2, 1:-1] - np.float32(2.0) * p[1:-1, 1:-1] + p[2:, 1:-1]
    xx = np.maximum(np.maximum(xx[:-2, 1:-1], xx[1:-1, 1:-1]), xx[2:, 1:-1])
    yy = np.maximum(np.maximum(yy[1:-1, :-2], yy[1:-1, 1:-1]), yy[1:-1, 2:])
    # Mixed derivative: bilinear in the four corner differences of the 3 x 3 coefficients around a
    # cell.
    cross = np.abs(inner[:-1, :-1] - inner[:-1, 1:] - inner[1:, :-1] + inner[1:, 1:])
    xy = np.maximum(
        np.maximum(cross[:-1, :-1], cross[:-1, 1:]), np.maximum(cross[1:, :-1], cross[1:, 1:])
    )
    return np.maximum(np.maximum(xx, yy) + xy, np.float32(0.0))
