# mypy: allow-untyped-defs
"""Compiled heart of the search: bounds of boxes, local ascent, the best-first loop over a heap.

Everything is flat arrays. ``points`` (K, 3) hold x, y, weight; ``terms`` (T, 8) integers: first
point, end point, is_inverse, offset of the coefficients, rows, columns, first level, offset of the
windows and curvatures; ``frames`` (T, 3): origin x, y and pitch; ``levels`` (L, 3): offset of the
bounds, columns, shift, of all fields after each other; ``level_of[span]``: the level whose windows
hold ``span + 1`` cells wherever they start; ``half_of[span]``: that of which two overlapping
windows hold them exactly. ``heap`` holds every slot of ``boxes`` once: the open ones as a binary
heap by ``keys``, behind them the free ones.

A box is (theta, x, y, half theta, half x, half y). The motion is ``p = R(theta) x + t`` for a
forward term and ``p = R(theta)^T (y - t)`` for an inverse one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["ascend", "bound_first", "bound_second", "evaluate", "run"]

# Slots of the search's counters and of its best pose.
NUM_OPEN, NUM_BOXES, NUM_SECOND, NUM_FOUND, STATUS = range(5)
DONE, CHUNK_ENDED, HEAP_FULL = range(3)


@njit(cache=True, nogil=True)
def _reach(cos, sin, tx, ty, h_x, h_y, swing, bow, is_inverse, x, y):
    """Turned point (about the centre of rotation), its place, and the rectangle a box takes it to.

    Returns the turned point, its place at the centre of the box, and middle and half widths of the
    rectangle. A turn by delta moves a turned point r by sin(delta) J r - (1 - cos(delta)) r.
    """
    if is_inverse:
        rx = cos * (x - tx) + sin * (y - ty)
        ry = -sin * (x - tx) + cos * (y - ty)
        e_x = abs(cos) * h_x + abs(sin) * h_y
        e_y = abs(sin) * h_x + abs(cos) * h_y
        half_x = e_x * (1.0 + bow) + swing * (abs(ry) + e_y) + 0.5 * bow * abs(rx)
        half_y = e_y * (1.0 + bow) + swing * (abs(rx) + e_x) + 0.5 * bow * abs(ry)
        return rx, ry, rx, ry, rx - 0.5 * bow * rx, ry - 0.5 * bow * ry, half_x, half_y
    rx = cos * x - sin * y
    ry = sin * x + cos * y
    px, py = rx + tx, ry + ty
    half_x = h_x + swing * abs(ry) + 0.5 * bow * abs(rx)
    half_y = h_y + swing * abs(rx) + 0.5 * bow * abs(ry)
    return rx, ry, px, py, px - 0.5 * bow * rx, py - 0.5 * bow * ry, half_x, half_y


@njit(cache=True, nogil=True)
def bound_first(points, terms, frames, levels, level_of, half_of, bounds, windows, box):
    """Upper bound over a box: every point at the best place that it can reach."""
    cos, sin = math.cos(box[0]), math.sin(box[0])
    swing = math.sin(box[3]) if box[3] < 0.5 * math.pi else 1.0
    bow = 1.0 - math.cos(min(box[3], math.pi))
    tx, ty, h_x, h_y = box[1], box[2], box[4], box[5]
    total = 0.0
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        num_rows, num_cols, first_level = terms[t, 4], terms[t, 5], terms[t, 6]
        at_windows = terms[t, 7]
        scale = 1.0 / frames[t, 2]
        shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
        for k in range(terms[t, 0], terms[t, 1]):
            _, _, _, _, mid_x, mid_y, half_x, half_y = _reach(
                cos, sin, tx, ty, h_x, h_y, swing, bow, is_inverse, points[k, 0], points[k, 1]
            )
            u, v = mid_x * scale + shift_x, mid_y * scale + shift_y
            eu, ev = half_x * scale + 1e-9, half_y * scale + 1e-9
            if u + eu < 0.0 or v + ev < 0.0 or u - eu >= num_cols or v - ev >= num_rows:
                continue
            i0, j0 = int(max(u - eu, 0.0)), int(max(v - ev, 0.0))
            i1, j1 = int(min(u + eu, num_cols - 1.0)), int(min(v + ev, num_rows - 1.0))
            span = max(i1 - i0, j1 - j0)
            if span < half_of.shape[0]:
                total += points[k, 2] * _largest(
                    windows, at_windows, num_rows, num_cols, half_of, i0, j0, i1, j1
                )
                continue
            row = first_level + level_of[span]
            shift = levels[row, 2]
            at = levels[row, 0] + (j0 >> shift) * levels[row, 1] + (i0 >> shift)
            total += points[k, 2] * bounds[at]
    return total


@njit(cache=True, nogil=True)
def _largest(windows, at, num_rows, num_cols, half_of, i0, j0, i1, j1):
    """Exact maximum over a rectangle of cells, from four overlapping windows."""
    level = half_of[max(i1 - i0, j1 - j0)]
    size = 1 << level
    at += level * num_rows * num_cols
    right, top = max(i1 - size + 1, i0), max(j1 - size + 1, j0)
    low, high = at + j0 * num_cols, at + top * num_cols
    return max(
        max(windows[low + i0], windows[low + right]),
        max(windows[high + i0], windows[high + right]),
    )


@njit(cache=True, nogil=True)
def bound_second(points, terms, frames, half_of, coefficients, curvatures, box, out):
    """Upper bound over a small box from value, summed gradient and bounded curvature.

    ``out``: the bound, the value at the centre, and the rise that theta, x and y can bring. The
    bound is infinite where the box is too large for the tables.
    """
    cos, sin = math.cos(box[0]), math.sin(box[0])
    swing, bow = math.sin(box[3]), 1.0 - math.cos(box[3])
    tx, ty, h_x, h_y = box[1], box[2], box[4], box[5]
    value = 0.0
    g_x, g_y, g_theta = 0.0, 0.0, 0.0
    all_a, b_x, b_y, m33, e_x, e_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    out[0], out[1] = math.inf, -math.inf
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        at_coefficients, num_rows, num_cols = terms[t, 3], terms[t, 4], terms[t, 5]
        at_curvatures = terms[t, 7]
        scale = 1.0 / frames[t, 2]
        shift_x, shift_y = 0.5 - frames[t, 0] * scale, 0.5 - frames[t, 1] * scale
        s0, sx, sy, s_theta, s_radial = 0.0, 0.0, 0.0, 0.0, 0.0
        la, lx, ly, lc = 0.0, 0.0, 0.0, 0.0
        for k in range(terms[t, 0], terms[t, 1]):
            rx, ry, px, py, mid_x, mid_y, half_x, half_y = _reach(
                cos, sin, tx, ty, h_x, h_y, swing, bow, is_inverse, points[k, 0], points[k, 1]
            )
            weight = points[k, 2]
            u, v = mid_x * scale + shift_x, mid_y * scale + shift_y
            eu, ev = half_x * scale + 1e-9, half_y * scale + 1e-9
            if u + eu < 0.0 or v + ev < 0.0 or u - eu >= num_cols or v - ev >= num_rows:
                continue
            i0, j0 = int(max(u - eu, 0.0)), int(max(v - ev, 0.0))
            i1, j1 = int(min(u + eu, num_cols - 1.0)), int(min(v + ev, num_rows - 1.0))
            if max(i1 - i0, j1 - j0) >= half_of.shape[0]:
                return
            curvature = weight * _largest(
                curvatures, at_curvatures, num_rows, num_cols, half_of, i0, j0, i1, j1
            )
            la += curvature
            lx += curvature * rx
            ly += curvature * ry
            lc += curvature * (rx * rx + ry * ry)
            u, v = px * scale + shift_x, py * scale + shift_y
            if not (1.0 <= u < num_cols - 1 and 1.0 <= v < num_rows - 1):
                continue
            i, j = int(u), int(v)
            a, b = u - 0.5 - i, v - 0.5 - j
            a0, a1, a2 = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
            b0, b1, b2 = 0.5 * (0.5 - b) ** 2, 0.75 - b * b, 0.5 * (0.5 + b) ** 2
            at = at_coefficients + (j - 1) * num_cols + i - 1
            c00, c01, c02 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            at += num_cols
            c10, c11, c12 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            at += num_cols
            c20, c21, c22 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            line0 = a0 * c00 + a1 * c01 + a2 * c02
            line1 = a0 * c10 + a1 * c11 + a2 * c12
            line2 = a0 * c20 + a1 * c21 + a2 * c22
            s0 += weight * (b0 * line0 + b1 * line1 + b2 * line2)
            fy = weight * scale * ((0.5 + b) * (line2 - line1) + (0.5 - b) * (line1 - line0))
            slope0 = (0.5 + a) * (c02 - c01) + (0.5 - a) * (c01 - c00)
            slope1 = (0.5 + a) * (c12 - c11) + (0.5 - a) * (c11 - c10)
            slope2 = (0.5 + a) * (c22 - c21) + (0.5 - a) * (c21 - c20)
            fx = weight * scale * (b0 * slope0 + b1 * slope1 + b2 * slope2)
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
def evaluate(points, terms, frames, coefficients, theta, tx, ty, gradient, hessian):
    """Objective at a pose with its exact gradient and second derivatives, order theta, x, y."""
    cos, sin = math.cos(theta), math.sin(theta)
    value = 0.0
    gradient[:] = 0.0
    hessian[:, :] = 0.0
    for t in range(terms.shape[0]):
        is_inverse = terms[t, 2] != 0
        at_coefficients, num_rows, num_cols = terms[t, 3], terms[t, 4], terms[t, 5]
        origin_x, origin_y, scale = frames[t, 0], frames[t, 1], 1.0 / frames[t, 2]
        for k in range(terms[t, 0], terms[t, 1]):
            x, y, weight = points[k, 0], points[k, 1], points[k, 2]
            if is_inverse:
                rx = cos * (x - tx) + sin * (y - ty)
                ry = -sin * (x - tx) + cos * (y - ty)
                u = (rx - origin_x) * scale + 0.5
                v = (ry - origin_y) * scale + 0.5
            else:
                rx = cos * x - sin * y
                ry = sin * x + cos * y
                u = (rx + tx - origin_x) * scale + 0.5
                v = (ry + ty - origin_y) * scale + 0.5
            if not (1.0 <= u < num_cols - 1 and 1.0 <= v < num_rows - 1):
                continue
            i, j = int(u), int(v)
            a, b = u - 0.5 - i, v - 0.5 - j
            a0, a1, a2 = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
            b0, b1, b2 = 0.5 * (0.5 - b) ** 2, 0.75 - b * b, 0.5 * (0.5 + b) ** 2
            at = at_coefficients + (j - 1) * num_cols + i - 1
            c00, c01, c02 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            at += num_cols
            c10, c11, c12 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            at += num_cols
            c20, c21, c22 = coefficients[at], coefficients[at + 1], coefficients[at + 2]
            line0 = a0 * c00 + a1 * c01 + a2 * c02
            line1 = a0 * c10 + a1 * c11 + a2 * c12
            line2 = a0 * c20 + a1 * c21 + a2 * c22
            slope0 = (0.5 + a) * (c02 - c01) + (0.5 - a) * (c01 - c00)
            slope1 = (0.5 + a) * (c12 - c11) + (0.5 - a) * (c11 - c10)
            slope2 = (0.5 + a) * (c22 - c21) + (0.5 - a) * (c21 - c20)
            value += weight * (b0 * line0 + b1 * line1 + b2 * line2)
            fx = weight * scale * (b0 * slope0 + b1 * slope1 + b2 * slope2)
            fy = weight * scale * ((0.5 + b) * (line2 - line1) + (0.5 - b) * (line1 - line0))
            second = weight * scale * scale
            fxx = second * (
                b0 * (c02 - 2.0 * c01 + c00)
                + b1 * (c12 - 2.0 * c11 + c10)
                + b2 * (c22 - 2.0 * c21 + c20)
            )
            fyy = second * (line2 - 2.0 * line1 + line0)
            fxy = second * ((0.5 + b) * (slope2 - slope1) + (0.5 - b) * (slope1 - slope0))
            if is_inverse:
                # p = R^T (y - t): dp/dtheta = -J p, dp/dt = -R^T.
                vx, vy = ry, -rx
                gradient[0] += fx * vx + fy * vy
                gradient[1] -= cos * fx - sin * fy
                gradient[2] -= sin * fx + cos * fy
                hx, hy = fxx * vx + fxy * vy, fxy * vx + fyy * vy
                hessian[0, 0] += hx * vx + hy * vy - fx * rx - fy * ry
                # d/dtheta of -R F' with F' in the rotated axes: -R (H v) - R J F'.
                mx, my = hx - fy, hy + fx
                hessian[0, 1] -= cos * mx - sin * my
                hessian[0, 2] -= sin * mx + cos * my
                hessian[1, 1] += cos * cos * fxx - 2.0 * cos * sin * fxy + sin * sin * fyy
                hessian[2, 2] += sin * sin * fxx + 2.0 * cos * sin * fxy + cos * cos * fyy
                hessian[1, 2] += cos * sin * (fxx - fyy) + (cos * cos - sin * sin) * fxy
            else:
                vx, vy = -ry, rx
                gradient[0] += fx * vx + fy * vy
                gradient[1] += fx
                gradient[2] += fy
                hx, hy = fxx * vx + fxy * vy, fxy * vx + fyy * vy
                hessian[0, 0] += hx * vx + hy * vy - fx * rx - fy * ry
                hessian[0, 1] += hx
                hessian[0, 2] += hy
                hessian[1, 1] += fxx
                hessian[1, 2] += fxy
                hessian[2, 2] += fyy
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
def ascend(points, terms, frames, coefficients, window, arm, reach, pose, max_steps):
    """Climb from `pose` (theta, x, y) in place, within the window; damped Newton steps.

    Returns the value reached.
    """
    gradient, hessian = np.zeros(3), np.zeros((3, 3))
    next_gradient, next_hessian = np.zeros(3), np.zeros((3, 3))
    step, trial = np.zeros(3), np.zeros(3)
    value = evaluate(
        points, terms, frames, coefficients, pose[0], pose[1], pose[2], gradient, hessian
    )
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
        found = evaluate(
            points,
            terms,
            frames,
            coefficients,
            trial[0],
            trial[1],
            trial[2],
            next_gradient,
            next_hessian,
        )
        if found > value:
            gain = found - value
            value = found
            pose[:] = trial
            gradient[:] = next_gradient
            hessian[:, :] = next_hessian
            damping *= 0.2
            if gain <= 1e-10 * abs(value) or length < 1e-6 * reach:
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
def _axis_to_split(child, arm, out):
    """Axis whose half width leaves most to be gained: 0 theta, 1 x, 2 y."""
    if out[0] < math.inf:
        rise_theta, rise_x, rise_y = out[2], out[3], out[4]
    else:
        rise_theta, rise_x, rise_y = child[3] * arm, child[4], child[5]
    if rise_theta >= rise_x and rise_theta >= rise_y:
        return 0
    return 1 if rise_x >= rise_y else 2


@njit(cache=True, nogil=True)
def run(
    points, terms, frames, levels, level_of, half_of, coefficients, bounds, windows, curvatures,
    window, arm, reach, margin, small, gap, keep, max_boxes,
    boxes, keys, heap, counters, best, found,
):  # fmt: skip
    """Search until the gap is closed or `max_boxes` more boxes were bounded.

    ``best``: lower bound, theta, x, y, ratio to the best from which on a centre is climbed from,
    largest bound of anything discarded. Boxes are discarded whose bound is below ``keep`` times
    the lower bound. ``found`` (F, 4): local optima met, a ring of value, theta, x, y. ``small``:
    reach [m] of a box up to which curvature is tried.
    """
    out = np.empty(5)
    child = np.zeros(6)
    pose = np.zeros(3)
    budget = counters[NUM_BOXES] + max_boxes
    counters[STATUS] = DONE
    while counters[NUM_OPEN] > 0:
        top = heap[0]
        if keys[top] <= best[0] or keys[top] - best[0] <= gap * keys[top]:
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
        child[axis + 3] *= 0.5
        centre = child[axis]
        for side in range(2):
            child[axis] = centre + (2 * side - 1) * child[axis + 3]
            upper = bound_first(
                points, terms, frames, levels, level_of, half_of, bounds, windows, child
            )
            upper = min(parent_key, upper + margin)
            counters[NUM_BOXES] += 1
            out[0] = math.inf
            floor = min(best[0], keep * best[0])
            if upper > floor and child[3] * arm + max(child[4], child[5]) <= small:
                bound_second(points, terms, frames, half_of, coefficients, curvatures, child, out)
                counters[NUM_SECOND] += 1
                upper = min(upper, out[0] + margin)
                if out[1] > best[0]:
                    best[0] = out[1]
                    best[1:4] = child[:3]
                if upper > best[0] and out[1] > best[4] * best[0]:
                    pose[:] = child[:3]
                    value = ascend(
                        points, terms, frames, coefficients, window, arm, reach, pose, 30
                    )
                    at = counters[NUM_FOUND] % found.shape[0]
                    found[at, 0] = value
                    found[at, 1:4] = pose
                    counters[NUM_FOUND] += 1
                    if value > best[0]:
                        best[0] = value
                        best[1:4] = pose
                        best[4] = 0.3
                    else:
                        # The more climbs fail, the better a centre has to be for the next.
                        best[4] += 0.1 * (1.0 - best[4])
            if upper <= floor:
                best[5] = max(best[5], upper)
                continue
            slot = heap[counters[NUM_OPEN]]
            boxes[slot, :6] = child
            boxes[slot, 6] = _axis_to_split(child, arm, out)
            keys[slot] = upper
            _push(keys, heap, counters[NUM_OPEN], slot)
            counters[NUM_OPEN] += 1
