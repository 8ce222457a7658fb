"""The signed field of a map: walls positive, free space negative, unknown zero."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import FilteredCells
from uw_dslam_ros2.core.registration.search.field import Field

__all__ = ["PAD", "padded_field", "signed_field", "wall_distance"]

FloatGrid = NDArray[np.float32]
PAD = 3
"""Cells of zeros around a field, so that it ends at zero."""


def wall_distance(cells: FilteredCells) -> FloatGrid:
    """Distance (R, C) from cells to the nearest wall, in cells; infinite without any wall."""
    import cv2  # large, so loaded when first used

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
    cells: FilteredCells,
    sigma_cells: float,
    free_penalty: float,
    stride: int = 1,
    distance: FloatGrid | None = None,
) -> Field:
    """Field of a map's cells, in cells of a lattice ``stride`` times coarser.

    A wall is worth exp(-d^2 / (2 sigma^2)) at distance d, free space -``free_penalty`` times its
    share of the neighbourhood, less as a wall comes near. ``sigma_cells`` is in cells of
    ``cells``; ``distance`` is `wall_distance` where it is known already.
    """
    import cv2  # large, so loaded when first used

    if distance is None:
        distance = wall_distance(cells)
    free = cv2.boxFilter(cells.free, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)
    # Nothing is known beyond the edge of a map, not even that a wall's kernel reaches there.
    return padded_field(_padded_means(distance, free, sigma_cells, free_penalty, stride, PAD))


def padded_field(coefficients: FloatGrid) -> Field:
    """Field with these coefficients (R + 2 PAD, C + 2 PAD), cell centres at whole numbers."""
    return Field(np.full(2, -float(PAD)), 1.0, coefficients)


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
