"""Compiled parts of the scan of all poses: turned maps, their correlation, and its peaks.

Each treats a stack of rotations a call, so that threads that match other maps meanwhile seldom
wait for the interpreter. Kernels that call each other share this file, because numba's cache
misses edits in another one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["correlate", "draw_turned", "find_peaks", "splat"]

FloatGrid = NDArray[np.float32]
FloatStack = NDArray[np.float32]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Spectrum = NDArray[np.complex64]


@njit(cache=True, nogil=True)
def splat(
    image: FloatGrid, points: FloatArray, weights: FloatArray,
    cos: float, sin: float, x: float, y: float,
) -> None:  # fmt: skip
    """Add weights to the four cells around each point (N, 2), turned and moved by (x, y)."""
    for k in range(points.shape[0]):
        at_x = cos * points[k, 0] - sin * points[k, 1] + x
        at_y = sin * points[k, 0] + cos * points[k, 1] + y
        col, row = math.floor(at_x), math.floor(at_y)
        fx, fy = at_x - col, at_y - row
        image[row, col] += weights[k] * (1.0 - fx) * (1.0 - fy)
        image[row, col + 1] += weights[k] * fx * (1.0 - fy)
        image[row + 1, col] += weights[k] * (1.0 - fx) * fy
        image[row + 1, col + 1] += weights[k] * fx * fy


@njit(cache=True, nogil=True)
def _span(start: float, slope: float, low: float, high: float, size: int) -> tuple[int, int]:
    """First k in 0..size - 1 with low <= start + slope k <= high, and one past the last.

    Up to rounding: the values at the two ends may lie outside by that.
    """
    if abs(slope) < 1e-9:
        is_inside = low <= start and start <= high
        return 0, size if is_inside else 0
    first, last = (low - start) / slope, (high - start) / slope
    if first > last:
        first, last = last, first
    return max(0, math.ceil(first)), min(size, math.floor(last) + 1)


@njit(cache=True, nogil=True)
def _draw_field(
    image: FloatGrid, side: int, field: FloatGrid, pad: int,
    cos: float, sin: float, x: float, y: float,
) -> None:  # fmt: skip
    """Draw a field turned about the origin and moved by (x, y), bilinear between its cells.

    Into the first rows and columns, ``side`` of them. ``field`` has a rim of ``pad`` zero cells,
    at least 2; the first cell within is at (0, 0).
    """
    num_rows, num_cols = field.shape
    low, high_x, high_y = pad - 1.0, float(num_cols - pad), float(num_rows - pad)
    for row in range(side):
        line = image[row]
        line[:side] = 0.0
        start_x = sin * (row - y) - cos * x + pad
        start_y = cos * (row - y) + sin * x + pad
        first, last = _span(start_x, cos, low, high_x, side)
        first_y, last_y = _span(start_y, -sin, low, high_y, side)
        # No test in the loop, so that the compiler uses vector instructions.
        for col in range(max(first, first_y), min(last, last_y)):
            at_x, at_y = start_x + cos * col, start_y - sin * col
            c, r = int(at_x), int(at_y)
            fx, fy = np.float32(at_x - c), np.float32(at_y - r)
            above = field[r, c] + fx * (field[r, c + 1] - field[r, c])
            below = field[r + 1, c] + fx * (field[r + 1, c + 1] - field[r + 1, c])
            line[col] = above + fy * (below - above)


@njit(cache=True, nogil=True)
def draw_turned(
    thetas: FloatArray, places: FloatArray,
    points: FloatArray, weights: FloatArray, field: FloatGrid, pad: int, center: FloatArray,
    side: int, stack: FloatStack,
) -> None:  # fmt: skip
    """Draw a map's points, and its field, at several rotations into a stack (K, 2, R, C).

    Parameters
    ----------
    thetas, places : (K,), (K, 2)
        Rotations about the ``center`` (2,), and where that comes to lie, [x, y] in pixels.
    points, weights : (N, 2), (N,)
        Relative to the centre.
    field : (R + 2 pad, C + 2 pad)
        With a rim of zeros.
    side
        All is drawn into the first rows and columns; the rest of the stack stays as it is.
    """
    for k in range(thetas.shape[0]):
        cos, sin = math.cos(thetas[k]), math.sin(thetas[k])
        x, y = places[k, 0], places[k, 1]
        walls, turned = stack[k, 0], stack[k, 1]
        walls[:side, :side] = 0.0
        splat(walls, points, weights, cos, sin, x, y)
        x -= cos * center[0] - sin * center[1]
        y -= sin * center[0] + cos * center[1]
        _draw_field(turned, side, field, pad, cos, sin, x, y)


@njit(cache=True, nogil=True)
def correlate(spectra: Spectrum, first: Spectrum, second: Spectrum) -> None:
    """Correlate each pair of images of a stack (K, 2, R, C) with two others (R, C), and add up.

    All are spectra; the sum replaces the pair's first.
    """
    size = first.size
    p, q = first.reshape(size), second.reshape(size)
    for k in range(spectra.shape[0]):
        a, b = spectra[k, 0].reshape(size), spectra[k, 1].reshape(size)
        for i in range(size):
            a[i] = np.conj(a[i]) * p[i] + np.conj(b[i]) * q[i]


@njit(cache=True, nogil=True)
def _column_maxima(image: FloatGrid, maxima: NDArray[np.float32]) -> None:
    maxima[:] = image[0]
    for row in range(1, image.shape[0]):
        for col in range(image.shape[1]):
            maxima[col] = max(maxima[col], image[row, col])


@njit(cache=True, nogil=True)
def _greatest(image: FloatGrid, maxima: NDArray[np.float32]) -> tuple[int, int]:
    """Row and column of the greatest value, given the columns' maxima."""
    col = int(np.argmax(maxima))
    for row in range(image.shape[0]):
        if image[row, col] == maxima[col]:
            return row, col
    return 0, col  # only where there are NaNs


@njit(cache=True, nogil=True)
def _erase_outside(image: FloatGrid, zero: FloatArray, last: IntArray, window: FloatArray) -> None:
    """Set -inf where a translation is outside a window; arguments as for `find_peaks`."""
    num_rows, num_cols = image.shape
    penalty = np.zeros(num_cols, np.float32)
    for col in range(num_cols):
        t_x = (col if col <= last[0] else col - num_cols) - zero[0]
        if t_x < window[0, 0] or t_x > window[1, 0]:
            penalty[col] = -np.inf
    for row in range(num_rows):
        line = image[row]
        t_y = (row if row <= last[1] else row - num_rows) - zero[1]
        if t_y < window[0, 1] or t_y > window[1, 1]:
            line[:] = -np.inf
        else:
            for col in range(num_cols):
                line[col] += penalty[col]


@njit(cache=True, nogil=True)
def _erase_around(
    image: FloatGrid, maxima: NDArray[np.float32], row: int, col: int, radius: int
) -> None:
    """Set -inf around a pixel, past the edges on the other side, and mend the columns' maxima."""
    num_rows, num_cols = image.shape
    for near in range(col - radius, col + radius + 1):
        c = near % num_cols
        for r in range(row - radius, row + radius + 1):
            image[r % num_rows, c] = -np.inf
        maximum = image[0, c]
        for r in range(1, num_rows):
            maximum = max(maximum, image[r, c])
        maxima[c] = maximum


@njit(cache=True, nogil=True)
def find_peaks(
    scores: FloatStack, zeros: FloatArray, last: IntArray, window: FloatArray, radius: int,
    peaks: FloatArray, greatest: FloatArray,
) -> None:  # fmt: skip
    """Greatest values of each image of a stack (K, R, C), and where; the stack is used up.

    Parameters
    ----------
    zeros : (K, 2)
        Pixel [x, y] that stands for no translation. Pixels past ``last`` (2,) stand for negative
        ones, as usual of correlations by Fourier transforms.
    window : (2, 2)
        Least and greatest translation [x, y] of a peak.
    radius
        How far a peak is from a better one, at least, in rows or in columns.
    peaks : (K, P, 3)
        Gets [t_x, t_y, value], best first; the value is -inf where a window holds fewer.
    greatest : (K, 3)
        Gets the same for the greatest value, whether it is inside the window or not.
    """
    num_rows, num_cols = scores.shape[1:]
    maxima = np.empty(num_cols, np.float32)
    for k in range(scores.shape[0]):
        image = scores[k]
        _column_maxima(image, maxima)
        for peak in range(-1, peaks.shape[1]):
            row, col = _greatest(image, maxima)
            found = greatest[k] if peak < 0 else peaks[k, peak]
            found[0] = (col if col <= last[0] else col - num_cols) - zeros[k, 0]
            found[1] = (row if row <= last[1] else row - num_rows) - zeros[k, 1]
            found[2] = image[row, col]
            if peak < 0:
                _erase_outside(image, zeros[k], last, window)
                _column_maxima(image, maxima)
            else:
                _erase_around(image, maxima, row, col, radius)
