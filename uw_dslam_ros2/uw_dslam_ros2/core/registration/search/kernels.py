# mypy: allow-untyped-defs
"""Compiled heart of the search: bounds of boxes, local ascent, the best-first loop over a heap.

Everything is flat arrays. ``points`` (4, K) hold x, y, weight, and the most that all later points
can bring; ``terms`` (T, 8) integers: first point, end point, is_inverse, offset of the
coefficients, rows, columns, first level, offset of the windows and curvatures; ``frames`` (T, 4):
origin x, y, pitch, and rounding of a place in cells; ``levels`` (L, 3): offset of the bounds,
columns, shift, of all fields after each other; ``level_of[span]``: the level whose windows hold
``span + 1`` cells wherever they start; ``half_of[span]``: that of which two overlapping windows
hold them exactly. ``heap`` holds every slot of ``boxes`` once: the open ones as a binary heap by
``keys``, behind them the free ones.

A box is (theta, x, y, half theta, half x, half y). The motion is ``p = R(theta) x + t`` for a
forward term and ``p = R(theta)^T (y - t)`` for an inverse one.

All of them stay in one file, long as it is: numba's cache of a compiled function looks at its own
file only, and would go on using an old version of what it calls in another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["UNSEEN", "ascend", "bound_first", "bound_second", "climb", "evaluate", "run"]

# In place of the axis to split: a box of a sweep, which curvature has not looked at.
UNSEEN = 3
# Slots of the search's counters, and what it stopped for.
NUM_OPEN, NUM_BOXES, NUM_SECOND, NUM_FOUND, STATUS = range(5)
DONE, CHUNK_ENDED, HEAP_FULL, FOUND_FULL = range(4)

_LEARNING = 1.0 / 16.0
_BOXES_PER_CLIMB = 10  # what one costs


@njit(cache=True, nogil=True)
def _turn(box):
    """Cosine and sine of the centre's turn; largest sin(delta) and 1 - cos(delta) beside it."""
    half = min(box[3], math.pi)
    swing = math.sin(half) if half < 0.5 * math.pi else 1.0
    return math.cos(box[0]), math.sin(box[0]), swing, 1.0 - math.cos(half)


@njit(cache=True, nogil=True)
def _rectangles(points, terms, frames, t, box, cos, sin, swing, bow, cells):
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
    bow *= 0.5
    if terms[t, 2] != 0:
        # The box of translations is turned, too, the other way round.
        origin_x, origin_y, sin = tx, ty, -sin
        e_x = scale * (abs(cos) * h_x + abs(sin) * h_y)
        e_y = scale * (abs(sin) * h_x + abs(cos) * h_y)
        reach_x = e_x * (1.0 + 2.0 * bow) + swing * e_y + rounding
        reach_y = e_y * (1.0 + 2.0 * bow) + swing * e_x + rounding
    else:
        origin_x, origin_y = 0.0, 0.0
        shift_x, shift_y = shift_x + scale * tx, shift_y + scale * ty
        reach_x, reach_y = scale * h_x + rounding, scale * h_y + rounding
    c, s, stay = cos * scale, sin * scale, 1.0 - bow
    xs, ys = points[0, first:end], points[1, first:end]
    low_x, low_y, high_x, high_y = cells[0], cells[1], cells[2], cells[3]
    for k in range(end - first):
        x, y = xs[k] - origin_x, ys[k] - origin_y
        rx, ry = c * x - s * y, s * x + c * y
        u, v = stay * rx + shift_x, stay * ry + shift_y
        half_x = reach_x + swing * abs(ry) + bow * abs(rx)
        half_y = reach_y + swing * abs(rx) + bow * abs(ry)
        low_x[k] = np.int32(min(max(u - half_x, 0.0), right))
        low_y[k] = np.int32(min(max(v - half_y, 0.0), top))
        high_x[k] = np.int32(min(max(u + half_x, 0.0), right))
        high_y[k] = np.int32(min(max(v + half_y, 0.0), top))


@njit(cache=True, nogil=True)
def bound_first(
    points, terms, frames, levels, level_of, half_of, bounds, windows, box, floor, cells
):
    """Upper bound over a box: every point at the best place that it can reach.

    Ends early, with a bound that is still true, once the other points cannot lift it over `floor`.
    """
    total = 0.0
    cos, sin, swing, bow = _turn(box)
    for t in range(terms.shape[0]):
        first, num_cols, plane = terms[t, 0], terms[t, 5], terms[t, 4] * terms[t, 5]
        at_windows = terms[t, 7]
        _rectangles(points, terms, frames, t, box, cos, sin, swing, bow, cells)
        count = terms[t, 1] - first
        if _find_corners(cells, count, num_cols, plane, half_of.shape[0]):
            lows, rights, ups = cells[0], cells[1], cells[2]
            for k in range(count):
                total += points[2, first + k] * _largest_of(
                    windows, at_windows + lows[k], rights[k], ups[k]
                )
                if k & 15 == 15 and total + points[3, first + k] <= floor:
                    return total + points[3, first + k]
            continue
        for k in range(count):
            i0, j0 = np.int64(cells[0, k]), np.int64(cells[1, k])
            i1, j1 = np.int64(cells[2, k]), np.int64(cells[3, k])
            span = max(i1 - i0, j1 - j0)
            if span < half_of.shape[0]:
                value = _largest(windows, at_windows, plane, num_cols, half_of, i0, j0, i1, j1)
            else:
                row = terms[t, 6] + level_of[span]
                shift = levels[row, 2]
                at = levels[row, 0] + (j0 >> shift) * levels[row, 1] + (i0 >> shift)
                value = bounds[np.uint64(at)]
            total += points[2, first + k] * value
            if k & 15 == 15 and total + points[3, first + k] <= floor:
                return total + points[3, first + k]
    return total


@njit(cache=True, nogil=True)
def _largest(windows, at, plane, num_cols, half_of, i0, j0, i1, j1):
    """Exact maximum over a rectangle of cells, from four overlapping windows.

    Unsigned indices, for numba asks of signed ones whether they count from the end.
    """
    level = np.int64(half_of[np.uint64(max(i1 - i0, j1 - j0))])
    size = 1 << level
    at += level * plane
    right, top = max(i1 - size + 1, i0), max(j1 - size + 1, j0)
    low, high = at + j0 * num_cols, at + top * num_cols
    return max(
        max(windows[np.uint64(low + i0)], windows[np.uint64(low + right)]),
        max(windows[np.uint64(high + i0)], windows[np.uint64(high + right)]),
    )


@njit(cache=True, nogil=True)
def _find_corners(cells, count, num_cols, plane, num_spans):
    """Replace rectangles of cells by where their four windows are: the first, steps to the others.

    Without branches, as above. False, and nothing is replaced, where one is too large.
    """
    i0s, j0s, i1s, j1s = cells[0], cells[1], cells[2], cells[3]
    largest = np.int32(0)
    for k in range(count):
        largest = max(largest, max(i1s[k] - i0s[k], j1s[k] - j0s[k]))
    if largest >= num_spans:
        return False
    cols, size_of_table = np.int32(num_cols), np.int32(plane)
    for k in range(count):
        i0, j0 = i0s[k], j0s[k]
        width, height = i1s[k] - i0, j1s[k] - j0
        span = max(width, height)
        level = np.int32(span >= 1) + np.int32(span >= 3) + np.int32(span >= 7)
        level += np.int32(span >= 15) + np.int32(span >= 31)
        more = (1 << level) - 1
        i0s[k] = level * size_of_table + j0 * cols + i0
        j0s[k] = max(width - more, np.int32(0))
        i1s[k] = max(height - more, np.int32(0)) * cols
    return True


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
    num_cols, cells, room,
):  # fmt: skip
    """Turned points, places between nodes, weights (0 outside) into ``room[:5]``.

    The nodes go into ``cells[3]``.
    """
    xs, ys, weights = points[0, first:], points[1, first:], points[2, first:]
    rxs, rys, us, vs, inside, nodes = room[0], room[1], room[2], room[3], room[4], cells[3]
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


@njit(cache=True, nogil=True)
def _fill_splines(coefficients, at, num_cols, scale, count, nodes, room):
    """Weighted values and slopes of the field into ``room[5:8]``."""
    at, cols = np.uint64(at), np.uint64(num_cols)
    one, two, twice = np.uint64(1), np.uint64(2), np.uint64(2 * num_cols)
    n00, n01, n02, n10, n11 = room[5], room[6], room[7], room[8], room[9]
    n12, n20, n21, n22 = room[10], room[11], room[12], room[13]
    for k in range(count):
        low = at + np.uint64(nodes[k])
        mid, high = low + cols, low + twice
        n00[k], n01[k], n02[k] = (
            coefficients[low],
            coefficients[low + one],
            coefficients[low + two],
        )
        n10[k], n11[k], n12[k] = (
            coefficients[mid],
            coefficients[mid + one],
            coefficients[mid + two],
        )
        n20[k], n21[k] = coefficients[high], coefficients[high + one]
        n22[k] = coefficients[high + two]
    along, across, weights = room[2], room[3], room[4]
    for k in range(count):
        a, b, weight = along[k], across[k], weights[k]
        a0, a1, a2 = 0.5 * (0.5 - a) * (0.5 - a), 0.75 - a * a, 0.5 * (0.5 + a) * (0.5 + a)
        b0, b1, b2 = 0.5 * (0.5 - b) * (0.5 - b), 0.75 - b * b, 0.5 * (0.5 + b) * (0.5 + b)
        c00, c01, c02, c10, c11 = n00[k], n01[k], n02[k], n10[k], n11[k]
        c12, c20, c21, c22 = n12[k], n20[k], n21[k], n22[k]
        line0 = a0 * c00 + a1 * c01 + a2 * c02
        line1 = a0 * c10 + a1 * c11 + a2 * c12
        line2 = a0 * c20 + a1 * c21 + a2 * c22
        slope0 = (0.5 + a) * (c02 - c01) + (0.5 - a) * (c01 - c00)
        slope1 = (0.5 + a) * (c12 - c11) + (0.5 - a) * (c11 - c10)
        slope2 = (0.5 + a) * (c22 - c21) + (0.5 - a) * (c21 - c20)
        rise = (0.5 + b) * (line2 - line1) + (0.5 - b) * (line1 - line0)
        n00[k] = weight * (b0 * line0 + b1 * line1 + b2 * line2)
        n01[k] = weight * scale * (b0 * slope0 + b1 * slope1 + b2 * slope2)
        n02[k] = weight * scale * rise


@njit(cache=True, nogil=True)
def _spline(coefficients, at, num_cols, a, b):
    """Value, slopes and second derivatives, in cells, of the spline at (a, b) from a node."""
    a0, a1, a2 = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
    b0, b1, b2 = 0.5 * (0.5 - b) ** 2, 0.75 - b * b, 0.5 * (0.5 + b) ** 2
    low, mid, high = np.uint64(at), np.uint64(at + num_cols), np.uint64(at + 2 * num_cols)
    one, two = np.uint64(1), np.uint64(2)
    c00, c01, c02 = coefficients[low], coefficients[low + one], coefficients[low + two]
    c10, c11, c12 = coefficients[mid], coefficients[mid + one], coefficients[mid + two]
    c20, c21, c22 = coefficients[high], coefficients[high + one], coefficients[high + two]
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


@njit(cache=True, nogil=True)
def bound_second(points, terms, frames, half_of, coefficients, curvatures, box, out, cells, room):
    """Upper bound over a small box from value, summed gradient and bounded curvature.

    ``out``: the bound, the value at the centre, and the rise that theta, x and y can bring. The
    bound is infinite where the box is too large for the tables. ``cells`` (4, K) of int32 and
    ``room`` (14, K) are scratch.
    """
    cos, sin, swing, bow = _turn(box)
    tx, ty, h_x, h_y = box[1], box[2], box[4], box[5]
    value = 0.0
    g_x, g_y, g_theta = 0.0, 0.0, 0.0
    all_a, b_x, b_y, m33, e_x, e_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    out[0], out[1] = math.inf, -math.inf
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        at_coefficients, num_rows, num_cols = terms[t, 3], terms[t, 4], terms[t, 5]
        at_curvatures, plane = terms[t, 7], terms[t, 4] * terms[t, 5]
        scale = 1.0 / frames[t, 2]
        shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
        if not is_inverse:
            shift_x, shift_y = shift_x + scale * tx, shift_y + scale * ty
        s0, sx, sy, s_theta, s_radial = 0.0, 0.0, 0.0, 0.0, 0.0
        la, lx, ly, lc = 0.0, 0.0, 0.0, 0.0
        first, count = terms[t, 0], terms[t, 1] - terms[t, 0]
        _rectangles(points, terms, frames, t, box, cos, sin, swing, bow, cells)
        if not _find_corners(cells, count, num_cols, plane, half_of.shape[0]):
            return
        _find_places(
            points, first, count, is_inverse, cos, sin, tx, ty, scale, shift_x, shift_y,
            num_rows, num_cols, cells, room,
        )  # fmt: skip
        _fill_splines(coefficients, at_coefficients, num_cols, scale, count, cells[3], room)
        bends, weights = room[8], points[2, first:]
        lows, rights, ups = cells[0], cells[1], cells[2]
        for k in range(count):
            bends[k] = weights[k] * _largest_of(
                curvatures, at_curvatures + lows[k], rights[k], ups[k]
            )
        rxs, rys, values, slopes_x, slopes_y = room[0], room[1], room[5], room[6], room[7]
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
    if swing > 0.0:
        if h_x > 0.0:
            q_x += abs(b_x) * swing / h_x
            q_theta += abs(b_x) * h_x / swing
        if h_y > 0.0:
            q_y += abs(b_y) * swing / h_y
            q_theta += abs(b_y) * h_y / swing
    out[2] = _parabola(abs(g_theta), q_theta, swing)
    out[3] = _parabola(abs(g_x), q_x, h_x)
    out[4] = _parabola(abs(g_y), q_y, h_y)
    rest = 0.5 * bow * bow * max(m33, 0.0) + bow * (abs(e_x) * h_x + abs(e_y) * h_y)
    out[0] = value + out[2] + out[3] + out[4] + rest
    out[1] = value


@njit(cache=True, nogil=True)
def _parabola(slope, curvature, half_width):
    """Largest value of ``slope d + curvature d^2 / 2`` for 0 <= d <= half_width."""
    if curvature < 0.0 and slope < -curvature * half_width:
        return -0.5 * slope * slope / curvature
    return half_width * (slope + 0.5 * curvature * half_width)


@njit(cache=True, nogil=True)
def evaluate(points, terms, frames, coefficients, pose, gradient, hessian):
    """Objective at a pose with its exact gradient and second derivatives, order theta, x, y."""
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
            field, fx, fy, fxx, fxy, fyy = _spline(
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
def ascend(
    points, terms, frames, coefficients, window, arm, reach, pose, max_steps, precision, work
):
    """Climb from `pose` (theta, x, y) in place, within the window; damped Newton steps.

    Ends where a step gains less than `precision` of the value. ``work`` (10, 3): scratch. Returns
    the value reached.
    """
    gradient, next_gradient, step, trial = work[0], work[1], work[2], work[3]
    hessian, next_hessian = work[4:7], work[7:10]
    value = evaluate(points, terms, frames, coefficients, pose, gradient, hessian)
    damping = abs(hessian[1, 1]) + abs(hessian[2, 2]) + 1e-9
    for _ in range(max_steps):
        if not _solve(hessian, damping, arm, gradient, step):
            damping *= 4.0
            continue
        length = max(abs(step[0]) * arm, max(abs(step[1]), abs(step[2])))
        if length > reach:
            damping *= 3.0
            continue
        for k in range(3):
            trial[k] = min(
                max(pose[k] + step[k], window[k] - window[k + 3]), window[k] + window[k + 3]
            )
        found = evaluate(points, terms, frames, coefficients, trial, next_gradient, next_hessian)
        if found > value:
            gain = found - value
            value = found
            pose[:] = trial
            gradient[:] = next_gradient
            hessian[:, :] = next_hessian
            damping *= 0.2
            if gain <= precision * abs(value) or length < 1e-6 * reach:
                break
        else:
            damping *= 5.0
            if length < 1e-5 * reach:
                break
    return value


@njit(cache=True, nogil=True)
def _push(keys, heap, count, slot):
    """Sift the box in `slot` up a heap of `count`, largest key first."""
    k = count
    key = keys[slot]
    while k > 0:
        parent = (k - 1) >> 1
        if keys[heap[parent]] >= key:
            break
        heap[k] = heap[parent]
        k = parent
    heap[k] = slot


@njit(cache=True, nogil=True)
def _pop(keys, heap, count):
    """Take the best box off a heap of `count`; its slot joins the free ones behind the heap."""
    top = heap[0]
    last = heap[count - 1]
    key = keys[last]
    size = count - 1
    k = 0
    while True:
        child = 2 * k + 1
        if child >= size:
            break
        if child + 1 < size and keys[heap[child + 1]] > keys[heap[child]]:
            child += 1
        if keys[heap[child]] <= key:
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
def _owner(found, count, theta, x, y, half_theta, half_x, half_y, arm, radius):
    """Best optimum in whose neighbourhood a box lies entirely, -1 if there is none."""
    owner = -1
    for k in range(count):
        if owner >= 0 and found[k, 0] <= found[owner, 0]:
            continue
        if abs(found[k, 2] - x) + half_x > radius:
            continue
        if abs(found[k, 3] - y) + half_y > radius:
            continue
        turn = abs(found[k, 1] - theta) % (2.0 * math.pi)
        if arm * (min(turn, 2.0 * math.pi - turn) + half_theta) <= radius:
            owner = k
    return owner


@njit(cache=True, nogil=True)
def _note(found, counters, value, pose, arm, radius):
    """Index of an optimum in the list, added if it is new; -1 where the list is full."""
    count = counters[NUM_FOUND]
    k = _owner(found, count, pose[0], pose[1], pose[2], 0.0, 0.0, 0.0, arm, radius)
    if k < 0:
        if count == found.shape[0]:
            return -1
        k = count
        counters[NUM_FOUND] += 1
        found[k, 0] = -math.inf
        found[k, 4] = -math.inf
    if value > found[k, 0]:
        found[k, 0] = value
        found[k, 1:4] = pose[:3]
    return k


@njit(cache=True, nogil=True)
def _try_climb(
    points, terms, frames, coefficients, window, arm, reach, value, box, best, found, counters,
    work,
):  # fmt: skip
    """Climb from a centre of that value, unless it is poor or beside a known, better optimum."""
    if value <= best[0]:
        if value <= best[4] * best[0]:
            return
        count = counters[NUM_FOUND]
        if _owner(found, count, box[0], box[1], box[2], 0.0, 0.0, 0.0, arm, reach) >= 0:
            return
    pose = work[10]
    pose[:] = box[:3]
    top = ascend(
        points, terms, frames, coefficients, window, arm, reach, pose, 30, 1e-8, work[:10]
    )
    _note(found, counters, top, pose, arm, 0.2 * reach)
    if top > best[0]:
        best[0] = top
        best[1:4] = pose
        best[4] = 0.3
    else:
        # The more climbs fail, the better a centre has to be for the next.
        best[4] += 0.1 * (1.0 - best[4])


@njit(cache=True, nogil=True)
def climb(
    points, terms, frames, coefficients, window, arm, reach, boxes, max_climbs, best, found,
    counters,
):  # fmt: skip
    """Climb from the best centres of some boxes (K, 6)."""
    work, values = np.empty((11, 3)), np.empty(boxes.shape[0])
    for k in range(boxes.shape[0]):
        values[k] = evaluate(points, terms, frames, coefficients, boxes[k, :3], work[0], work[4:7])
    order = np.argsort(-values)
    for k in order[:max_climbs]:
        _try_climb(
            points, terms, frames, coefficients, window, arm, reach, values[k], boxes[k], best,
            found, counters, work,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def run(
    points, terms, frames, levels, level_of, half_of, coefficients, bounds, windows, curvatures,
    window, arm, reach, margin, small, gap, keep, radius, max_boxes,
    boxes, keys, heap, counters, best, found, worth,
):  # fmt: skip
    """Search until the gap is closed or `max_boxes` more boxes were bounded.

    ``best``: lower bound, theta, x, y, ratio to the best from which on a centre is climbed from,
    largest bound of a box that led to an optimum from outside its neighbourhood. ``found``
    (F, 5): optima met: value, theta, x, y, largest bound of the boxes counted to it. ``small``:
    reach [m] of a box up to which curvature is tried; ``worth``: by size of the box, mean share
    of the way down to the lower bound that it went.

    Boxes are discarded once their bound is below ``keep`` times the lower bound. With ``radius``
    = 0 the search ends when the gap is closed. With a positive one [m], every box above ``keep``
    is followed until it is discarded or lies in the neighbourhood, of that radius, of an optimum;
    what is still above as a box of a cell belongs to the optimum that a climb from there leads to.
    """
    out, work = np.empty(5), np.empty((11, 3))
    child, pose = np.zeros(6), np.zeros(3)
    cells, room = np.empty((4, points.shape[1]), np.int32), np.empty((14, points.shape[1]))
    near = 0.2 * reach
    budget = counters[NUM_BOXES] + max_boxes
    counters[STATUS] = DONE
    while counters[NUM_OPEN] > 0:
        top = heap[0]
        is_unseen = boxes[top, 6] == UNSEEN
        if radius > 0.0:
            if keys[top] <= keep * best[0]:
                return
            box = boxes[top]
            owner = _owner(
                found, counters[NUM_FOUND], box[0], box[1], box[2], box[3], box[4], box[5], arm,
                radius,
            )  # fmt: skip
            # A box of a sweep is about that small, but not yet well bounded: it is split first.
            size = max(box[3] * arm, max(box[4], box[5]))
            is_small = not is_unseen and size <= 0.6 * near
            if owner < 0 and is_small:
                pose[:] = box[:3]
                value = ascend(
                    points, terms, frames, coefficients, window, arm, reach, pose, 50, 1e-6,
                    work[:10],
                )  # fmt: skip
                owner = _note(found, counters, value, pose, arm, near)
                if owner < 0:
                    counters[STATUS] = FOUND_FULL
                    return
                counters[NUM_BOXES] += _BOXES_PER_CLIMB
                if value > best[0]:
                    best[0] = value
                    best[1:4] = pose
                best[5] = max(best[5], keys[top])
            # Around the best, the bound of all is the bound; around others it is worth some boxes.
            if owner >= 0 and (
                is_small
                or found[owner, 0] >= (1.0 - gap) * best[0]
                or keys[top] * (1.0 - gap) <= found[owner, 0]
            ):
                found[owner, 4] = max(found[owner, 4], keys[top])
                _pop(keys, heap, counters[NUM_OPEN])
                counters[NUM_OPEN] -= 1
                continue
        elif keys[top] <= best[0] or keys[top] - best[0] <= gap * keys[top]:
            return
        if counters[NUM_BOXES] >= budget:
            counters[STATUS] = CHUNK_ENDED
            return
        if counters[NUM_OPEN] + 2 > heap.shape[0]:
            counters[STATUS] = HEAP_FULL
            return
        _pop(keys, heap, counters[NUM_OPEN])
        counters[NUM_OPEN] -= 1
        parent_key = keys[top]
        axis = int(boxes[top, 6])
        child[:] = boxes[top, :6]
        centre = 0.0
        if not is_unseen:
            child[axis + 3] *= 0.5
            centre = child[axis]
        for side in range(1 if is_unseen else 2):
            floor = min(best[0], keep * best[0])
            first = parent_key
            if not is_unseen:
                child[axis] = centre + (2 * side - 1) * child[axis + 3]
                first = margin + bound_first(
                    points, terms, frames, levels, level_of, half_of, bounds, windows, child,
                    floor - margin, cells,
                )  # fmt: skip
            upper = min(parent_key, first)
            counters[NUM_BOXES] += 1
            out[0] = math.inf
            size = child[3] * arm + max(child[4], child[5])
            level = min(
                int(2.0 * math.log2(max(small / max(size, 1e-300), 1.0))), worth.shape[0] - 1
            )
            # What seldom helps in boxes of that size is tried now and then only.
            is_tried = radius > 0.0 or worth[level] > 0.7 or counters[NUM_BOXES] & 14 == 0
            # In the first phase, what lies below the best is only kept for the second.
            wanted = floor if radius > 0.0 else best[0]
            if upper > wanted and size <= small and (is_tried or is_unseen):
                bound_second(
                    points, terms, frames, half_of, coefficients, curvatures, child, out, cells,
                    room,
                )  # fmt: skip
                counters[NUM_SECOND] += 1
                gain = (first - max(out[0] + margin, wanted)) / (first - wanted)
                worth[level] += _LEARNING * (max(gain, 0.0) - worth[level])
                upper = min(upper, out[0] + margin)
                if upper > wanted:
                    _try_climb(
                        points, terms, frames, coefficients, window, arm, reach, out[1], child,
                        best, found, counters, work,
                    )  # fmt: skip
                if out[1] > best[0]:
                    best[0] = out[1]
                    best[1:4] = child[:3]
            if upper <= floor:
                continue
            slot = heap[counters[NUM_OPEN]]
            boxes[slot, :6] = child
            boxes[slot, 6] = _axis_to_split(child, arm, out)
            keys[slot] = upper
            _push(keys, heap, counters[NUM_OPEN], slot)
            counters[NUM_OPEN] += 1
