# mypy: allow-untyped-defs
"""Compiled heart of the search: bounds of boxes, local ascent, the best-first loop over a heap.

A box is (theta, x, y, half theta, half x, half y). The motion is ``p = R(theta) x + t`` for a
forward term and ``p = R(theta)^T (y - t)`` for an inverse one.

All of them stay in one file, long as it is: numba's cache of a compiled function looks at its own
file only, and would go on using an old version of what it calls in another.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "UNSEEN",
    "Bounds",
    "State",
    "Sum",
    "ascend",
    "bound_first",
    "bound_second",
    "climb",
    "evaluate",
    "follow_rivals",
    "prove",
    "spline_values",
]

# In place of the axis to split: a box of a sweep, which curvature has not looked at.
UNSEEN = 3
# Slots of the search's counters, and what it stopped for.
NUM_OPEN, NUM_BOXES, NUM_FOUND = range(3)
DONE, CHUNK_ENDED, HEAP_FULL, FOUND_FULL = range(4)

_NUM_SPANS = (
    63  # two windows of the last level hold so many cells; beyond, the highest value counts
)
_LEARNING = 1.0 / 16.0
_BOXES_PER_CLIMB = 10  # what one costs
_NEAR = 0.2  # of the reach: optima nearer than that are one

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]


class Sum(NamedTuple):
    """The terms as flat arrays, and where their sum is looked at."""

    points: FloatArray  # (4, K): x, y, weight, and the most that all later points can bring
    # (T, 7): first point, end point, is_inverse, offset of the coefficients, rows, columns, offset
    # of the windows and curvatures
    terms: IntArray
    frames: FloatArray  # (T, 5): origin x, y, pitch, rounding of a place in cells, highest value
    coefficients: Float32Array  # of all fields
    window: FloatArray  # (6,), a box
    arm: float  # a turn moves the mean point by it [m]
    reach: float  # of an optimum's surroundings [m]


class Bounds(NamedTuple):
    """What bounds are read from, of all fields after each other."""

    windows: Float32Array  # largest values in 2^k x 2^k cells from each cell on
    curvatures: Float32Array  # the same of second derivatives [1 / m^2]
    margin: float  # for what rounding may take off a sum
    small: float  # reach [m] of a box up to which curvature is tried


class State(NamedTuple):
    """A running search."""

    boxes: FloatArray  # (S, 7), the last is the axis to split
    keys: FloatArray  # (S,), their bounds
    heap: NDArray[np.int32]  # every slot once: the open boxes as a binary heap, then the free ones
    counters: IntArray
    # (6,): lower bound, theta, x, y, ratio to the best from which on a centre is climbed from,
    # largest bound of a box that led to an optimum from outside its neighbourhood
    best: FloatArray
    found: FloatArray  # (F, 5): optima met: value, theta, x, y, largest bound of their boxes
    worth: FloatArray  # by size of a box: share of the way to the lower bound that curvature went


@njit(cache=True, nogil=True)
def _turn(box):
    """Cosine and sine of the centre's turn; largest sin(delta) and 1 - cos(delta) beside it."""
    half = min(box[3], math.pi)
    max_sin = math.sin(half) if half < 0.5 * math.pi else 1.0
    return math.cos(box[0]), math.sin(box[0]), max_sin, 1.0 - math.cos(half)


@njit(cache=True, nogil=True)
def _rectangles(points, terms, frames, t, box, cos, sin, max_sin, versine, cells):
    """Cells that a term's points can reach: first column and row, last column and row.

    A turn by delta moves a turned point r by sin(delta) J r - (1 - cos(delta)) r. What lies beyond
    the field is moved to its rim, which is zero. There are no branches, so that the compiler uses
    vector instructions.
    """
    first, end = terms[t, 0], terms[t, 1]
    scale, rounding = 1.0 / frames[t, 2], frames[t, 3]
    shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
    right, top = terms[t, 5] - 1.0, terms[t, 4] - 1.0
    tx, ty, h_x, h_y = box[1], box[2], box[4], box[5]
    versine *= 0.5
    if terms[t, 2] != 0:
        # The box of translations is turned, too, the other way round.
        origin_x, origin_y, sin = tx, ty, -sin
        e_x = scale * (abs(cos) * h_x + abs(sin) * h_y)
        e_y = scale * (abs(sin) * h_x + abs(cos) * h_y)
        reach_x = e_x * (1.0 + 2.0 * versine) + max_sin * e_y + rounding
        reach_y = e_y * (1.0 + 2.0 * versine) + max_sin * e_x + rounding
    else:
        origin_x, origin_y = 0.0, 0.0
        shift_x, shift_y = shift_x + scale * tx, shift_y + scale * ty
        reach_x, reach_y = scale * h_x + rounding, scale * h_y + rounding
    c, s, stay = cos * scale, sin * scale, 1.0 - versine
    xs, ys = points[0, first:end], points[1, first:end]
    low_x, low_y, high_x, high_y = cells[0], cells[1], cells[2], cells[3]
    for k in range(end - first):
        x, y = xs[k] - origin_x, ys[k] - origin_y
        rx, ry = c * x - s * y, s * x + c * y
        u, v = stay * rx + shift_x, stay * ry + shift_y
        half_x = reach_x + max_sin * abs(ry) + versine * abs(rx)
        half_y = reach_y + max_sin * abs(rx) + versine * abs(ry)
        low_x[k] = np.int32(min(max(u - half_x, 0.0), right))
        low_y[k] = np.int32(min(max(v - half_y, 0.0), top))
        high_x[k] = np.int32(min(max(u + half_x, 0.0), right))
        high_y[k] = np.int32(min(max(v + half_y, 0.0), top))


@njit(cache=True, nogil=True)
def bound_first(total, windows, box, floor, cells):
    """Upper bound over a box: every point at the best place that it can reach.

    Ends early, with a bound that is still true, once the other points cannot lift it over `floor`.
    ``cells`` (4, K) of int32 is scratch.
    """
    points, terms, frames, upper = total.points, total.terms, total.frames, 0.0
    cos, sin, max_sin, versine = _turn(box)
    for t in range(terms.shape[0]):
        first, count = terms[t, 0], terms[t, 1] - terms[t, 0]
        _rectangles(points, terms, frames, t, box, cos, sin, max_sin, versine, cells)
        _find_corners(cells, count, terms[t, 5], terms[t, 4] * terms[t, 5])
        lows, rights, ups = cells[0], cells[1], cells[2]
        for k in range(count):
            value = frames[t, 4]
            if lows[k] >= 0:
                value = _largest_of(windows, terms[t, 6] + lows[k], rights[k], ups[k])
            upper += points[2, first + k] * value
            if k & 15 == 15 and upper + points[3, first + k] <= floor:
                return upper + points[3, first + k]
    return upper


@njit(cache=True, nogil=True)
def _find_corners(cells, count, num_cols, plane):
    """Replace rectangles of cells by where their four windows are: the first, steps to the others.

    Without branches, as above. Where one is too large for the windows, -1 stands for the first.
    Returns whether none is.
    """
    i0s, j0s, i1s, j1s = cells[0], cells[1], cells[2], cells[3]
    cols, size_of_table = np.int32(num_cols), np.int32(plane)
    largest = np.int32(0)
    for k in range(count):
        i0, j0 = i0s[k], j0s[k]
        width, height = i1s[k] - i0, j1s[k] - j0
        span = max(width, height)
        largest = max(largest, span)
        level = np.int32(span >= 1) + np.int32(span >= 3) + np.int32(span >= 7)
        level += np.int32(span >= 15) + np.int32(span >= 31)
        more = (1 << level) - 1
        i0s[k] = level * size_of_table + j0 * cols + i0 if span < _NUM_SPANS else np.int32(-1)
        j0s[k] = max(width - more, np.int32(0))
        i1s[k] = max(height - more, np.int32(0)) * cols
    return largest < _NUM_SPANS


@njit(cache=True, nogil=True)
def _largest_of(windows, at, right, up):
    """Exact maximum over a rectangle of cells, from four overlapping windows.

    Unsigned indices, for numba asks of signed ones whether they count from the end.
    """
    low, high = np.uint64(at), np.uint64(at + up)
    step = np.uint64(right)
    return max(max(windows[low], windows[low + step]), max(windows[high], windows[high + step]))


@njit(cache=True, nogil=True)
def _find_places(
    points, first, count, is_inverse, cos, sin, tx, ty, scale, shift_x, shift_y, num_rows,
    num_cols, cells, scratch,
):  # fmt: skip
    """Turned points, places between nodes, weights (0 outside) into ``scratch[:5]``.

    The nodes go into ``cells[3]``.
    """
    xs, ys, weights = points[0, first:], points[1, first:], points[2, first:]
    rxs, rys, us, vs, inside, nodes = (
        scratch[0],
        scratch[1],
        scratch[2],
        scratch[3],
        scratch[4],
        cells[3],
    )
    origin_x, origin_y = 0.0, 0.0
    if is_inverse:
        origin_x, origin_y, sin = tx, ty, -sin
    right, top, cols = num_cols - 1.0, num_rows - 1.0, float(num_cols)
    # Several loops of few arrays each: the compiler gives up on telling many apart.
    for k in range(count):
        x, y = xs[k] - origin_x, ys[k] - origin_y
        rxs[k], rys[k] = cos * x - sin * y, sin * x + cos * y
    for k in range(count):
        us[k], vs[k] = rxs[k] * scale + shift_x, rys[k] * scale + shift_y
    for k in range(count):
        u, v = us[k], vs[k]
        is_inside = (u >= 1.0) & (u < right) & (v >= 1.0) & (v < top)
        inside[k] = weights[k] if is_inside else 0.0
    for k in range(count):
        u, v = us[k], vs[k]
        i, j = np.floor(min(max(u, 1.0), right - 1.0)), np.floor(min(max(v, 1.0), top - 1.0))
        us[k], vs[k] = u - 0.5 - i, v - 0.5 - j
        nodes[k] = np.int32((j - 1.0) * cols + i - 1.0)


@njit(cache=True, nogil=True, inline="always")
def _spline(a, b, c00, c01, c02, c10, c11, c12, c20, c21, c22):
    """Value, slopes, second derivatives xx, xy, yy, in cells, at (a, b) from the node of c11."""
    a0, a1, a2 = 0.5 * (0.5 - a) * (0.5 - a), 0.75 - a * a, 0.5 * (0.5 + a) * (0.5 + a)
    b0, b1, b2 = 0.5 * (0.5 - b) * (0.5 - b), 0.75 - b * b, 0.5 * (0.5 + b) * (0.5 + b)
    line0 = a0 * c00 + a1 * c01 + a2 * c02
    line1 = a0 * c10 + a1 * c11 + a2 * c12
    line2 = a0 * c20 + a1 * c21 + a2 * c22
    slope0 = (0.5 + a) * (c02 - c01) + (0.5 - a) * (c01 - c00)
    slope1 = (0.5 + a) * (c12 - c11) + (0.5 - a) * (c11 - c10)
    slope2 = (0.5 + a) * (c22 - c21) + (0.5 - a) * (c21 - c20)
    bend0, bend1, bend2 = c02 - 2.0 * c01 + c00, c12 - 2.0 * c11 + c10, c22 - 2.0 * c21 + c20
    return (
        b0 * line0 + b1 * line1 + b2 * line2,
        b0 * slope0 + b1 * slope1 + b2 * slope2,
        (0.5 + b) * (line2 - line1) + (0.5 - b) * (line1 - line0),
        b0 * bend0 + b1 * bend1 + b2 * bend2,
        (0.5 + b) * (slope2 - slope1) + (0.5 - b) * (slope1 - slope0),
        line2 - 2.0 * line1 + line0,
    )


@njit(cache=True, nogil=True, inline="always")
def _spline_at(coefficients, at, num_cols, a, b):
    """The same from the flat index of c00. Unsigned, for numba asks whether they are negative."""
    low, mid, high = np.uint64(at), np.uint64(at + num_cols), np.uint64(at + 2 * num_cols)
    one, two = np.uint64(1), np.uint64(2)
    return _spline(
        a, b, coefficients[low], coefficients[low + one], coefficients[low + two],
        coefficients[mid], coefficients[mid + one], coefficients[mid + two],
        coefficients[high], coefficients[high + one], coefficients[high + two],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def spline_values(coefficients, nodes):
    """Values and slopes [1 / cell] (N, 3) of a field (R, C) at positions (N, 2) in cells."""
    num_rows, num_cols = coefficients.shape
    flat, values = coefficients.ravel(), np.zeros((nodes.shape[0], 3))
    for k in range(nodes.shape[0]):
        u, v = nodes[k, 0] + 0.5, nodes[k, 1] + 0.5
        if 1.0 <= u < num_cols - 1 and 1.0 <= v < num_rows - 1:
            i, j = int(u), int(v)
            at = (j - 1) * num_cols + i - 1
            values[k, 0], values[k, 1], values[k, 2], _, _, _ = _spline_at(
                flat, at, num_cols, u - 0.5 - i, v - 0.5 - j
            )
    return values


@njit(cache=True, nogil=True)
def _fill_splines(coefficients, at, num_cols, scale, count, nodes, scratch):
    """Weighted values and slopes of the field into ``scratch[5:8]``."""
    at, cols = np.uint64(at), np.uint64(num_cols)
    one, two, twice = np.uint64(1), np.uint64(2), np.uint64(2 * num_cols)
    n00, n01, n02, n10, n11 = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    n12, n20, n21, n22 = scratch[10], scratch[11], scratch[12], scratch[13]
    # Fetched first and counted afterwards, which the compiler does with vector instructions.
    for k in range(count):
        low = at + np.uint64(nodes[k])
        mid, high = low + cols, low + twice
        n00[k], n01[k] = coefficients[low], coefficients[low + one]
        n02[k], n10[k] = coefficients[low + two], coefficients[mid]
        n11[k], n12[k] = coefficients[mid + one], coefficients[mid + two]
        n20[k], n21[k] = coefficients[high], coefficients[high + one]
        n22[k] = coefficients[high + two]
    along, across, weights = scratch[2], scratch[3], scratch[4]
    for k in range(count):
        value, slope_x, slope_y, _, _, _ = _spline(
            along[k], across[k], n00[k], n01[k], n02[k], n10[k], n11[k], n12[k], n20[k], n21[k],
            n22[k],
        )  # fmt: skip
        weight = weights[k]
        n00[k] = weight * value
        n01[k] = weight * scale * slope_x
        n02[k] = weight * scale * slope_y


@njit(cache=True, nogil=True)
def bound_second(total, curvatures, box, out, cells, scratch):
    """Upper bound over a small box from value, summed gradient and bounded curvature.

    ``out``: the bound, the value at the centre, and the rise that theta, x and y can bring. The
    bound is infinite where the box is too large for the tables. ``cells`` (4, K) of int32 and
    ``scratch`` is (14, K).
    """
    points, terms, frames, coefficients = (
        total.points,
        total.terms,
        total.frames,
        total.coefficients,
    )
    cos, sin, max_sin, versine = _turn(box)
    tx, ty, h_x, h_y = box[1], box[2], box[4], box[5]
    value = 0.0
    g_x, g_y, g_theta = 0.0, 0.0, 0.0
    all_a, b_x, b_y, m33, e_x, e_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    out[0], out[1] = math.inf, -math.inf
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        at_coefficients, num_rows, num_cols = terms[t, 3], terms[t, 4], terms[t, 5]
        at_curvatures, plane = terms[t, 6], terms[t, 4] * terms[t, 5]
        scale = 1.0 / frames[t, 2]
        shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
        if not is_inverse:
            shift_x, shift_y = shift_x + scale * tx, shift_y + scale * ty
        s0, sx, sy, s_theta, s_radial = 0.0, 0.0, 0.0, 0.0, 0.0
        la, lx, ly, lc = 0.0, 0.0, 0.0, 0.0
        first, count = terms[t, 0], terms[t, 1] - terms[t, 0]
        _rectangles(points, terms, frames, t, box, cos, sin, max_sin, versine, cells)
        if not _find_corners(cells, count, num_cols, plane):
            return
        _find_places(
            points, first, count, is_inverse, cos, sin, tx, ty, scale, shift_x, shift_y,
            num_rows, num_cols, cells, scratch,
        )  # fmt: skip
        _fill_splines(coefficients, at_coefficients, num_cols, scale, count, cells[3], scratch)
        bends, weights = scratch[8], points[2, first:]
        lows, rights, ups = cells[0], cells[1], cells[2]
        for k in range(count):
            bends[k] = weights[k] * _largest_of(
                curvatures, at_curvatures + lows[k], rights[k], ups[k]
            )
        rxs, rys, values, slopes_x, slopes_y = (
            scratch[0],
            scratch[1],
            scratch[5],
            scratch[6],
            scratch[7],
        )
        for k in range(count):
            rx, ry, curvature = rxs[k], rys[k], bends[k]
            fx, fy = slopes_x[k], slopes_y[k]
            la += curvature
            lx += curvature * rx
            ly += curvature * ry
            lc += curvature * (rx * rx + ry * ry)
            s0 += values[k]
            sx += fx
            sy += fy
            s_theta += fy * rx - fx * ry
            s_radial += fx * rx + fy * ry
        value += s0
        m33 += lc - s_radial
        all_a += la
        if is_inverse:
            # The motion of t counts turned back; vectors in turned axes, then those of t.
            g_x -= cos * sx - sin * sy
            g_y -= sin * sx + cos * sy
            g_theta -= s_theta
            cross_x, cross_y = sy - ly, lx - sx
            b_x += cos * cross_x - sin * cross_y
            b_y += sin * cross_x + cos * cross_y
            rest_x, rest_y = sx - lx, sy - ly
            e_x += cos * rest_x - sin * rest_y
            e_y += sin * rest_x + cos * rest_y
        else:
            g_x += sx
            g_y += sy
            g_theta += s_theta
            b_x -= ly
            b_y += lx
            e_x += lx
            e_y += ly
    # f <= f0 + g d + 1/2 d^T M d over |d| <= h, the mixed terms split between the axes.
    q_x, q_y, q_theta = all_a, all_a, m33
    if max_sin > 0.0:
        if h_x > 0.0:
            q_x += abs(b_x) * max_sin / h_x
            q_theta += abs(b_x) * h_x / max_sin
        if h_y > 0.0:
            q_y += abs(b_y) * max_sin / h_y
            q_theta += abs(b_y) * h_y / max_sin
    out[2] = _parabola(abs(g_theta), q_theta, max_sin)
    out[3] = _parabola(abs(g_x), q_x, h_x)
    out[4] = _parabola(abs(g_y), q_y, h_y)
    rest = 0.5 * versine * versine * max(m33, 0.0) + versine * (abs(e_x) * h_x + abs(e_y) * h_y)
    out[0] = value + out[2] + out[3] + out[4] + rest
    out[1] = value


@njit(cache=True, nogil=True)
def _parabola(slope, curvature, half_width):
    """Largest value of ``slope d + curvature d^2 / 2`` for 0 <= d <= half_width."""
    if curvature < 0.0 and slope < -curvature * half_width:
        return -0.5 * slope * slope / curvature
    return half_width * (slope + 0.5 * curvature * half_width)


@njit(cache=True, nogil=True)
def evaluate(total, pose, gradient, hessian):
    """Objective at a pose with its exact gradient and second derivatives, order theta, x, y."""
    points, terms, frames, coefficients = (
        total.points,
        total.terms,
        total.frames,
        total.coefficients,
    )
    cos, sin = math.cos(pose[0]), math.sin(pose[0])
    value = 0.0
    gradient[:] = 0.0
    hessian[:, :] = 0.0
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        at_coefficients, num_rows, num_cols = terms[t, 3], terms[t, 4], terms[t, 5]
        scale = 1.0 / frames[t, 2]
        shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
        if not is_inverse:
            shift_x, shift_y = shift_x + scale * pose[1], shift_y + scale * pose[2]
        s0, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        s_theta, s_x, s_y, s_turn = 0.0, 0.0, 0.0, 0.0
        for k in range(terms[t, 0], terms[t, 1]):
            x, y, weight = points[0, k], points[1, k], points[2, k]
            if is_inverse:
                x, y = x - pose[1], y - pose[2]
                rx, ry = cos * x + sin * y, cos * y - sin * x
            else:
                rx, ry = cos * x - sin * y, sin * x + cos * y
            u, v = rx * scale + shift_x, ry * scale + shift_y
            if not (1.0 <= u < num_cols - 1 and 1.0 <= v < num_rows - 1):
                continue
            i, j = int(u), int(v)
            at = at_coefficients + (j - 1) * num_cols + i - 1
            field, fx, fy, fxx, fxy, fyy = _spline_at(
                coefficients, at, num_cols, u - 0.5 - i, v - 0.5 - j
            )
            first, second = weight * scale, weight * scale * scale
            fx, fy, fxx, fxy, fyy = (
                first * fx,
                first * fy,
                second * fxx,
                second * fxy,
                second * fyy,
            )
            s0 += weight * field
            sx += fx
            sy += fy
            sxx += fxx
            sxy += fxy
            syy += fyy
            # The point moves along J r as theta grows.
            s_theta += fy * rx - fx * ry
            hx, hy = fxy * rx - fxx * ry, fyy * rx - fxy * ry
            s_x += hx
            s_y += hy
            s_turn += hy * rx - hx * ry - fx * rx - fy * ry
        value += s0
        hessian[0, 0] += s_turn
        if is_inverse:
            # p = R^T (y - t): dp/dtheta = -J p, dp/dt = -R^T; d/dtheta of -R F' adds -R J F'.
            gradient[0] -= s_theta
            gradient[1] -= cos * sx - sin * sy
            gradient[2] -= sin * sx + cos * sy
            mx, my = s_x + sy, s_y - sx
            hessian[0, 1] += cos * mx - sin * my
            hessian[0, 2] += sin * mx + cos * my
            hessian[1, 1] += cos * cos * sxx - 2.0 * cos * sin * sxy + sin * sin * syy
            hessian[2, 2] += sin * sin * sxx + 2.0 * cos * sin * sxy + cos * cos * syy
            hessian[1, 2] += cos * sin * (sxx - syy) + (cos * cos - sin * sin) * sxy
        else:
            gradient[0] += s_theta
            gradient[1] += sx
            gradient[2] += sy
            hessian[0, 1] += s_x
            hessian[0, 2] += s_y
            hessian[1, 1] += sxx
            hessian[1, 2] += sxy
            hessian[2, 2] += syy
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return value


@njit(cache=True, nogil=True)
def _solve(matrix, damping, arm, right, step):
    """Solve ``(-matrix + damping diag(arm^2, 1, 1)) step = right`` by Cholesky.

    False if that matrix is not positive definite.
    """
    a = -matrix[0, 0] + damping * arm * arm
    b = -matrix[1, 1] + damping
    c = -matrix[2, 2] + damping
    d, e, f = -matrix[0, 1], -matrix[0, 2], -matrix[1, 2]
    if a <= 0.0:
        return False
    l11 = math.sqrt(a)
    l21, l31 = d / l11, e / l11
    b -= l21 * l21
    if b <= 1e-12 * abs(damping):
        return False
    l22 = math.sqrt(b)
    l32 = (f - l31 * l21) / l22
    c -= l31 * l31 + l32 * l32
    if c <= 1e-12 * abs(damping):
        return False
    l33 = math.sqrt(c)
    y1 = right[0] / l11
    y2 = (right[1] - l21 * y1) / l22
    y3 = (right[2] - l31 * y1 - l32 * y2) / l33
    step[2] = y3 / l33
    step[1] = (y2 - l32 * step[2]) / l22
    step[0] = (y1 - l21 * step[1] - l31 * step[2]) / l11
    return True


@njit(cache=True, nogil=True)
def ascend(total, longest, pose, max_steps, precision, work):
    """Climb from `pose` (theta, x, y) in place, within the window; damped Newton steps.

    A step moves the points by ``longest`` at most. Ends where one gains less than `precision` of
    the value. ``work`` (10, 3): scratch. Returns the value reached.
    """
    arm, window = total.arm, total.window
    gradient, next_gradient, step, trial = work[0], work[1], work[2], work[3]
    hessian, next_hessian = work[4:7], work[7:10]
    value = evaluate(total, pose, gradient, hessian)
    damping = abs(hessian[1, 1]) + abs(hessian[2, 2]) + 1e-9
    for _ in range(max_steps):
        if not _solve(hessian, damping, arm, gradient, step):
            damping *= 4.0
            continue
        length = max(abs(step[0]) * arm, max(abs(step[1]), abs(step[2])))
        if length > longest:
            damping *= 3.0
            continue
        for k in range(3):
            trial[k] = min(
                max(pose[k] + step[k], window[k] - window[k + 3]), window[k] + window[k + 3]
            )
        found = evaluate(total, trial, next_gradient, next_hessian)
        if found > value:
            gain = found - value
            value = found
            pose[:] = trial
            gradient[:] = next_gradient
            hessian[:, :] = next_hessian
            damping *= 0.2
            if gain <= precision * abs(value) or length < 1e-6 * longest:
                break
        else:
            damping *= 5.0
            if length < 1e-5 * longest:
                break
    return value


@njit(cache=True, nogil=True)
def _put(state, box, axis, key):
    """Add a box to the heap, largest key first."""
    keys, heap, k = state.keys, state.heap, state.counters[NUM_OPEN]
    slot = heap[k]
    state.boxes[slot, :6] = box
    state.boxes[slot, 6], keys[slot] = axis, key
    while k > 0:
        parent = (k - 1) >> 1
        if keys[heap[parent]] >= key:
            break
        heap[k] = heap[parent]
        k = parent
    heap[k] = slot
    state.counters[NUM_OPEN] += 1


@njit(cache=True, nogil=True)
def _take(state):
    """Slot of the best box, taken off the heap; it is free now, and the next to be filled."""
    state.counters[NUM_OPEN] -= 1
    keys, heap, size = state.keys, state.heap, state.counters[NUM_OPEN]
    top, last, k = heap[0], heap[size], 0
    while True:
        child = 2 * k + 1
        if child >= size:
            break
        if child + 1 < size and keys[heap[child + 1]] > keys[heap[child]]:
            child += 1
        if keys[heap[child]] <= keys[last]:
            break
        heap[k] = heap[child]
        k = child
    heap[k] = last
    heap[size] = top
    return top


@njit(cache=True, nogil=True)
def _axis_to_split(box, arm, out):
    """Axis whose half width leaves most to be gained: 0 theta, 1 x, 2 y."""
    if out[0] < math.inf:
        rise_theta, rise_x, rise_y = out[2], out[3], out[4]
    else:
        rise_theta, rise_x, rise_y = box[3] * arm, box[4], box[5]
    if rise_theta >= rise_x and rise_theta >= rise_y:
        return 0
    return 1 if rise_x >= rise_y else 2


@njit(cache=True, nogil=True)
def _owner(state, box, halves, arm, radius):
    """Best optimum in whose neighbourhood a box lies entirely, -1 if there is none."""
    found, owner = state.found, -1
    for k in range(state.counters[NUM_FOUND]):
        if owner >= 0 and found[k, 0] <= found[owner, 0]:
            continue
        if abs(found[k, 2] - box[1]) + halves[1] > radius:
            continue
        if abs(found[k, 3] - box[2]) + halves[2] > radius:
            continue
        turn = abs(found[k, 1] - box[0]) % (2.0 * math.pi)
        if arm * (min(turn, 2.0 * math.pi - turn) + halves[0]) <= radius:
            owner = k
    return owner


@njit(cache=True, nogil=True)
def _note(total, state, value, pose):
    """Index of an optimum in the list, added if it is new; -1 where the list is full."""
    found, counters, best = state.found, state.counters, state.best
    k = _owner(state, pose, np.zeros(3), total.arm, _NEAR * total.reach)
    if value > best[0]:
        best[0] = value
        best[1:4] = pose
    if k < 0:
        if counters[NUM_FOUND] == found.shape[0]:
            return -1
        k = counters[NUM_FOUND]
        counters[NUM_FOUND] += 1
        found[k, 0] = found[k, 4] = -math.inf
    if value > found[k, 0]:
        found[k, 0] = value
        found[k, 1:4] = pose
    return k


@njit(cache=True, nogil=True)
def _try_climb(total, state, value, box, work):
    """Climb from a centre of that value, unless it is poor or beside a known, better optimum."""
    best = state.best
    if value <= best[0]:
        if value <= best[4] * best[0]:
            return
        if _owner(state, box, np.zeros(3), total.arm, total.reach) >= 0:
            return
    pose, before = work[10], best[0]
    pose[:] = box[:3]
    top = ascend(total, total.reach, pose, 30, 1e-8, work[:10])
    _note(total, state, top, pose)
    if top > before:
        best[4] = 0.3
    else:
        # The more climbs fail, the better a centre has to be for the next.
        best[4] += 0.1 * (1.0 - best[4])


@njit(cache=True, nogil=True)
def climb(total, state, boxes, max_climbs):
    """Climb from the best centres of some boxes (K, 6)."""
    work, values = np.empty((11, 3)), np.empty(boxes.shape[0])
    for k in range(boxes.shape[0]):
        values[k] = evaluate(total, boxes[k, :3], work[0], work[4:7])
    for k in np.argsort(-values)[:max_climbs]:
        _try_climb(total, state, values[k], boxes[k], work)


@njit(cache=True, nogil=True)
def _bound(total, bounds, state, box, key, is_unseen, keep, wanted, scratch):
    """Upper bound of a box, at most ``key``, that of what it is part of.

    Curvature is asked where it could take the bound below ``wanted``. Where it does not, the
    centre may be worth a climb.
    """
    out, work, cells, scratch = scratch
    best, worth, margin = state.best, state.worth, bounds.margin
    first = key
    if not is_unseen:
        floor = min(best[0], keep * best[0]) - margin
        first = margin + bound_first(total, bounds.windows, box, floor, cells)
    upper = min(key, first)
    state.counters[NUM_BOXES] += 1
    out[0] = math.inf
    size = box[3] * total.arm + max(box[4], box[5])
    if upper <= wanted or size > bounds.small:
        return upper
    level = min(int(2.0 * np.log2(bounds.small / max(size, 1e-300))), worth.shape[0] - 1)
    # What seldom helps in boxes of that size is tried now and then only.
    is_tried = is_unseen or wanted < best[0] or worth[level] > 0.7
    if not is_tried and state.counters[NUM_BOXES] & 14 != 0:
        return upper
    bound_second(total, bounds.curvatures, box, out, cells, scratch)
    gain = (first - max(out[0] + margin, wanted)) / (first - wanted)
    worth[level] += _LEARNING * (max(gain, 0.0) - worth[level])
    upper = min(upper, out[0] + margin)
    if upper > wanted:
        _try_climb(total, state, out[1], box, work)
    if out[1] > best[0]:
        best[0] = out[1]
        best[1:4] = box[:3]
    return upper


@njit(cache=True, nogil=True)
def _split(total, bounds, state, keep, is_proof, scratch):
    """Replace the best box by its halves, as far as they can hold ``keep`` times the best value.

    One of a sweep is looked at itself.
    """
    best, slot = state.best, _take(state)
    key, axis, child = state.keys[slot], int(state.boxes[slot, 6]), state.boxes[slot, :6].copy()
    is_unseen = axis == UNSEEN
    if is_unseen:
        num_parts, centre = 1, 0.0
    else:
        num_parts, centre = 2, child[axis]
        child[axis + 3] *= 0.5
    for part in range(num_parts):
        if not is_unseen:
            child[axis] = centre + (2 * part - 1) * child[axis + 3]
        # While the best is to be proven, what lies below it is only kept for the rivals.
        wanted = best[0] if is_proof else min(best[0], keep * best[0])
        upper = _bound(total, bounds, state, child, key, is_unseen, keep, wanted, scratch)
        if upper > min(best[0], keep * best[0]):
            _put(state, child, _axis_to_split(child, total.arm, scratch[0]), upper)


@njit(cache=True, nogil=True)
def _limit(state, budget):
    """Which limit keeps the next box from being split, if any."""
    if state.counters[NUM_BOXES] >= budget:
        return CHUNK_ENDED
    return HEAP_FULL if state.counters[NUM_OPEN] + 2 > state.heap.shape[0] else DONE


@njit(cache=True, nogil=True)
def _make_scratch(total):
    num_points = total.points.shape[1]
    cells, scratch = np.empty((4, num_points), np.int32), np.empty((14, num_points))
    return np.empty(5), np.empty((11, 3)), cells, scratch


@njit(cache=True, nogil=True)
def prove(total, bounds, state, gap, keep, max_boxes):
    """Split the best box until the gap is closed, or `max_boxes` more boxes were bounded.

    Boxes are discarded once their bound is below ``keep`` times the lower bound. Returns DONE, or
    what it stopped for.
    """
    scratch, budget = _make_scratch(total), state.counters[NUM_BOXES] + max_boxes
    while state.counters[NUM_OPEN] > 0:
        key, best = state.keys[state.heap[0]], state.best[0]
        if key <= best or key - best <= gap * key:
            return DONE
        limit = _limit(state, budget)
        if limit != DONE:
            return limit
        _split(total, bounds, state, keep, True, scratch)
    return DONE


@njit(cache=True, nogil=True)
def follow_rivals(total, bounds, state, gap, keep, radius, max_boxes):
    """Follow every box above ``keep`` times the best, until it is excluded or an optimum's own.

    It is an optimum's own if it lies in its neighbourhood, of that ``radius`` [m], or if a climb
    from there, once it is as small as a cell, leads to that optimum.
    """
    scratch, budget = _make_scratch(total), state.counters[NUM_BOXES] + max_boxes
    while state.counters[NUM_OPEN] > 0:
        if state.keys[state.heap[0]] <= keep * state.best[0]:
            return DONE
        owner = _find_owner(total, state, gap, radius, scratch[1])
        if owner == -2:
            return FOUND_FULL
        if owner >= 0:
            slot = _take(state)
            state.found[owner, 4] = max(state.found[owner, 4], state.keys[slot])
            continue
        limit = _limit(state, budget)
        if limit != DONE:
            return limit
        _split(total, bounds, state, keep, False, scratch)
    return DONE


@njit(cache=True, nogil=True)
def _find_owner(total, state, gap, radius, work):
    """Optimum that the best box is counted to; -1 if it is to be split, -2 if there is no room."""
    slot, best, found = state.heap[0], state.best, state.found
    box, key = state.boxes[slot], state.keys[slot]
    owner = _owner(state, box, box[3:6], total.arm, radius)
    # A box of a sweep is about that small, but not yet well bounded: it is split first.
    size = max(box[3] * total.arm, max(box[4], box[5]))
    is_small = box[6] != UNSEEN and size <= 0.6 * _NEAR * total.reach
    if owner < 0 and is_small:
        pose = work[10]
        pose[:] = box[:3]
        value = ascend(total, total.reach, pose, 50, 1e-6, work[:10])
        owner = _note(total, state, value, pose)
        if owner < 0:
            return -2
        state.counters[NUM_BOXES] += _BOXES_PER_CLIMB
        best[5] = max(best[5], key)
    # Around the best, the bound of all is the bound; around others it is worth some boxes.
    if owner >= 0 and (
        is_small
        or found[owner, 0] >= (1.0 - gap) * best[0]
        or key * (1.0 - gap) <= found[owner, 0]
    ):
        return owner
    return -1
