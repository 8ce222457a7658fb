"""Compiled parts of the registration of grids: the signed fields, their bounds, and the objective.

All positions are [x, y] in working cells, cell centres at whole numbers. A field is a quadratic
B-spline whose coefficients (R, C) carry a rim of ``pad`` zero cells; it is once continuously
differentiable, so that both a maximum over a region and a curvature are bounded by tables. Poses:
the source's points, centred, turn by theta and land at t. Kernels that call each other share this
file, because numba's cache misses edits in another one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["ascend_all", "bound_boxes", "objective", "objective_at", "point_gradients"]

FloatGrid = NDArray[np.float32]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
TableArray = NDArray[np.int16]

TABLE_STEP = 1.0 / 16000.0
"""Tables of values hold bounds rounded up to whole multiples of this."""
CURVATURE_STEP = 1.0 / 2000.0
"""The same for tables of curvatures, which reach 12 for the harshest fields."""


@njit(cache=True, nogil=True)
def _value_gradient(coefficients: FloatGrid, x: float, y: float) -> tuple[float, float, float]:
    """Field and its gradient [1 / cell] at (x, y), padded coordinates; 0 outside."""
    num_rows, num_cols = coefficients.shape
    if x < 0.5 or y < 0.5 or x >= num_cols - 1.5 or y >= num_rows - 1.5:
        return 0.0, 0.0, 0.0
    col, row = int(x + 0.5), int(y + 0.5)
    dx, dy = x - col, y - row
    wx0, wx1, wx2 = 0.5 * (0.5 - dx) ** 2, 0.75 - dx * dx, 0.5 * (0.5 + dx) ** 2
    gx0, gx1, gx2 = dx - 0.5, -2.0 * dx, dx + 0.5
    value, grad_x, grad_y = 0.0, 0.0, 0.0
    for k in range(3):
        if k == 0:
            wy, gy = 0.5 * (0.5 - dy) ** 2, dy - 0.5
        elif k == 1:
            wy, gy = 0.75 - dy * dy, -2.0 * dy
        else:
            wy, gy = 0.5 * (0.5 + dy) ** 2, dy + 0.5
        c0 = coefficients[row - 1 + k, col - 1]
        c1 = coefficients[row - 1 + k, col]
        c2 = coefficients[row - 1 + k, col + 1]
        line = wx0 * c0 + wx1 * c1 + wx2 * c2
        value += wy * line
        grad_y += gy * line
        grad_x += wy * (gx0 * c0 + gx1 * c1 + gx2 * c2)
    return value, grad_x, grad_y


@njit(cache=True, nogil=True)
def objective(
    pose: FloatArray,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    center: FloatArray, pad: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Objective at pose [theta, t_x, t_y] and its gradient [1 / rad, 1 / cell, 1 / cell].

    ``source`` (M, 2) is relative to ``center``; ``target`` (N, 2) is in target cells.
    """
    cos, sin = math.cos(pose[0]), math.sin(pose[0])
    total, d_theta, d_x, d_y = 0.0, 0.0, 0.0, 0.0
    for i in range(source.shape[0]):
        px = cos * source[i, 0] - sin * source[i, 1]
        py = sin * source[i, 0] + cos * source[i, 1]
        value, gx, gy = _value_gradient(target_field, px + pose[1] + pad, py + pose[2] + pad)
        weight = source_weight[i]
        total += weight * value
        d_theta += weight * (gy * px - gx * py)
        d_x += weight * gx
        d_y += weight * gy
    for j in range(target.shape[0]):
        ux, uy = target[j, 0] - pose[1], target[j, 1] - pose[2]
        qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
        value, gx, gy = _value_gradient(source_field, qx + center[0] + pad, qy + center[1] + pad)
        weight = target_weight[j]
        total += weight * value
        d_theta += weight * (gx * qy - gy * qx)
        d_x -= weight * (cos * gx - sin * gy)
        d_y -= weight * (sin * gx + cos * gy)
    return total, d_theta, d_x, d_y


@njit(cache=True, nogil=True)
def _ascend(
    start: FloatArray, radius: float, max_steps: int,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    center: FloatArray, pad: float,
) -> tuple[FloatArray, float]:  # fmt: skip
    """Local maximum (3,) that a pose climbs to, and its value, by BFGS steps.

    Turns are scaled by ``radius``, so that all three numbers are cells. A step is halved until the
    value rises enough (Armijo), and never longer than two cells.
    """
    scale = np.array([1.0 / radius, 1.0, 1.0])
    pose = start.copy()
    value, g0, g1, g2 = objective(
        pose, source, source_weight, target_field,
        target, target_weight, source_field, center, pad,
    )  # fmt: skip
    gradient = np.array([g0, g1, g2]) * scale
    inverse = np.eye(3)
    is_first = True
    for _ in range(max_steps):
        step = inverse @ gradient
        slope = np.dot(step, gradient)
        if slope <= 0.0:
            inverse, step = np.eye(3), gradient.copy()
            slope = np.dot(step, gradient)
        length = math.sqrt(np.dot(step, step))
        if length < 1e-7 or slope < 1e-14:
            break
        limit = 0.5 if is_first else 2.0
        share = min(1.0, limit / length)
        if is_first:
            share = limit / length
        is_found = False
        for _ in range(20):
            trial = pose + share * step * scale
            trial_value, g0, g1, g2 = objective(
                trial, source, source_weight, target_field,
                target, target_weight, source_field, center, pad,
            )  # fmt: skip
            if trial_value >= value + 1e-4 * share * slope:
                is_found = True
                break
            share *= 0.5
        if not is_found:
            if is_first:
                break
            inverse, is_first = np.eye(3), True
            continue
        trial_gradient = np.array([g0, g1, g2]) * scale
        moved, turned = share * step, gradient - trial_gradient
        along = np.dot(moved, turned)
        if along > 1e-12:
            if is_first:
                inverse = np.eye(3) * (along / np.dot(turned, turned))
            left = np.eye(3) - np.outer(moved, turned) / along
            inverse = left @ inverse @ left.T + np.outer(moved, moved) / along
            is_first = False
        has_stalled = trial_value - value < 1e-9
        pose, value, gradient = trial, trial_value, trial_gradient
        if has_stalled:
            break
    return pose, value


@njit(cache=True, nogil=True)
def ascend_all(
    starts: FloatArray, radius: float, max_steps: int,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    center: FloatArray, pad: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Local maxima (K, 3) that poses (K, 3) climb to, and their values."""
    poses, values = np.empty_like(starts), np.empty(starts.shape[0])
    for k in range(starts.shape[0]):
        poses[k], values[k] = _ascend(
            starts[k], radius, max_steps, source, source_weight, target_field,
            target, target_weight, source_field, center, pad,
        )  # fmt: skip
    return poses, values


@njit(cache=True, nogil=True)
def objective_at(
    poses: FloatArray,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    center: FloatArray, pad: float,
) -> FloatArray:  # fmt: skip
    """Objective at many poses (K, 3)."""
    values = np.empty(poses.shape[0])
    for k in range(poses.shape[0]):
        values[k] = objective(
            poses[k], source, source_weight, target_field,
            target, target_weight, source_field, center, pad,
        )[0]  # fmt: skip
    return values


@njit(cache=True, nogil=True)
def point_gradients(
    pose: FloatArray,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    center: FloatArray, pad: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Each point's part of the gradient of `objective` (M + N, 3), and its place (M + N, 2).

    The source's points come first; places are in target cells.
    """
    cos, sin = math.cos(pose[0]), math.sin(pose[0])
    count = source.shape[0]
    gradients = np.empty((count + target.shape[0], 3))
    places = np.empty((count + target.shape[0], 2))
    for i in range(count):
        px = cos * source[i, 0] - sin * source[i, 1]
        py = sin * source[i, 0] + cos * source[i, 1]
        x, y = px + pose[1], py + pose[2]
        _, gx, gy = _value_gradient(target_field, x + pad, y + pad)
        places[i, 0], places[i, 1] = x, y
        gradients[i, 0] = source_weight[i] * (gy * px - gx * py)
        gradients[i, 1], gradients[i, 2] = source_weight[i] * gx, source_weight[i] * gy
    for j in range(target.shape[0]):
        ux, uy = target[j, 0] - pose[1], target[j, 1] - pose[2]
        qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
        _, gx, gy = _value_gradient(source_field, qx + center[0] + pad, qy + center[1] + pad)
        places[count + j] = target[j]
        gradients[count + j, 0] = target_weight[j] * (gx * qy - gy * qx)
        gradients[count + j, 1] = -target_weight[j] * (cos * gx - sin * gy)
        gradients[count + j, 2] = -target_weight[j] * (sin * gx + cos * gy)
    return gradients, places


@njit(cache=True, nogil=True, inline="always")
def _region_max(
    tables: TableArray, layer_of_width: IntArray, width_of_layer: IntArray,
    low_x: float, high_x: float, low_y: float, high_y: float,
) -> int:  # fmt: skip
    """Bound of a table's quantity over a region; positions count cells, cell 0 starting at 0."""
    num_rows, num_cols = tables.shape[1], tables.shape[2]
    if high_x < 0.0 or high_y < 0.0 or low_x >= num_cols or low_y >= num_rows:
        return 0
    # The rim is as wide as the widest window, so that a window moved to the edge still covers
    # the same values. Truncation is the floor of what is not negative, and several times quicker.
    col, row = int(max(low_x, 0.0)), int(max(low_y, 0.0))
    last_col, last_row = int(high_x), int(high_y)
    width = max(last_row - row, last_col - col) + 1
    if width < layer_of_width.shape[0]:
        return tables[layer_of_width[width], row, col]
    layer = tables.shape[0] - 1
    step = width_of_layer[layer]
    best = -32768
    for window_row in range(row, min(last_row + 1, num_rows), step):
        for window_col in range(col, min(last_col + 1, num_cols), step):
            best = max(best, tables[layer, window_row, window_col])
    return best


@njit(cache=True, nogil=True)
def _table_bound(
    theta: float, t_x: float, t_y: float, half_rad: float, half: float, threshold: float,
    source: FloatArray, source_weight: FloatArray, target_tables: TableArray,
    target: FloatArray, target_weight: FloatArray, source_tables: TableArray,
    center: FloatArray, pad: float, scale: float,
    layer_of_width: IntArray, width_of_layer: IntArray,
) -> float:  # fmt: skip
    """Sum of each point's greatest field value over the region that it can reach from the box.

    ``scale`` is the number of table cells per working cell. Gives up early, with a bound that is
    still true, once the rest cannot lift it over ``threshold``.
    """
    cos, sin = math.cos(theta), math.sin(theta)
    arc, sag = math.sin(min(half_rad, 0.5 * math.pi)), 1.0 - math.cos(half_rad)
    turned_half = half * min(math.sqrt(2.0), abs(cos) + abs(sin) + math.sqrt(2.0) * half_rad)
    # Table cells tile the plane from half a working cell before the first centre on.
    shift = pad + 0.5
    total, rest = 0.0, 0.0
    for i in range(source.shape[0]):
        rest += source_weight[i]
    for j in range(target.shape[0]):
        rest += target_weight[j]
    for k in range(max(source.shape[0], target.shape[0])):
        if k < source.shape[0]:
            px = cos * source[k, 0] - sin * source[k, 1]
            py = sin * source[k, 0] + cos * source[k, 1]
            half_x = half + abs(py) * arc + abs(px) * sag
            half_y = half + abs(px) * arc + abs(py) * sag
            x, y = px + t_x + shift, py + t_y + shift
            total += source_weight[k] * TABLE_STEP * _region_max(
                target_tables, layer_of_width, width_of_layer,
                scale * (x - half_x), scale * (x + half_x),
                scale * (y - half_y), scale * (y + half_y),
            )  # fmt: skip
            rest -= source_weight[k]
        if k < target.shape[0]:
            ux, uy = target[k, 0] - t_x, target[k, 1] - t_y
            qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
            half_x = turned_half + abs(qy) * arc + abs(qx) * sag
            half_y = turned_half + abs(qx) * arc + abs(qy) * sag
            x, y = qx + center[0] + shift, qy + center[1] + shift
            total += target_weight[k] * TABLE_STEP * _region_max(
                source_tables, layer_of_width, width_of_layer,
                scale * (x - half_x), scale * (x + half_x),
                scale * (y - half_y), scale * (y + half_y),
            )  # fmt: skip
            rest -= target_weight[k]
        if (k & 15) == 15 and total + rest <= threshold:
            return total + rest  # no field exceeds 1
    return total


@njit(cache=True, nogil=True)
def _smooth_bound(
    theta: float, t_x: float, t_y: float, half_rad: float, half: float,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target_curvature: TableArray,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    source_curvature: TableArray,
    center: FloatArray, pad: float, layer_of_width: IntArray, width_of_layer: IntArray,
) -> tuple[float, float]:  # fmt: skip
    """Value at the box's centre, and a second-order bound over the box.

    A point moves by d = J u + e, u the pose's offset; then F(p + d) <= F(p) + dF.J u + |dF| |e| +
    max(curvature) |d|^2 / 2 with the greatest curvature over the region it reaches. The gradients
    are summed over all points before their size is taken, which is what makes the bound close
    quadratically.
    """
    cos, sin = math.cos(theta), math.sin(theta)
    reach_t = math.sqrt(2.0) * half
    total, rest, g_theta, g_x, g_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(source.shape[0]):
        px = cos * source[i, 0] - sin * source[i, 1]
        py = sin * source[i, 0] + cos * source[i, 1]
        radius = math.sqrt(px * px + py * py)
        reach = reach_t + radius * half_rad
        x, y = px + t_x + pad, py + t_y + pad
        curvature = CURVATURE_STEP * _region_max(
            target_curvature, layer_of_width, width_of_layer,
            x + 0.5 - reach, x + 0.5 + reach, y + 0.5 - reach, y + 0.5 + reach,
        )  # fmt: skip
        value, gx, gy = _value_gradient(target_field, x, y)
        weight = source_weight[i]
        total += weight * value
        g_theta += weight * (gy * px - gx * py)
        g_x += weight * gx
        g_y += weight * gy
        error = 0.5 * radius * half_rad * half_rad
        rest += weight * (math.sqrt(gx * gx + gy * gy) * error + 0.5 * curvature * reach * reach)
    for j in range(target.shape[0]):
        ux, uy = target[j, 0] - t_x, target[j, 1] - t_y
        qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
        radius = math.sqrt(qx * qx + qy * qy)
        reach = reach_t + radius * half_rad
        x, y = qx + center[0] + pad, qy + center[1] + pad
        curvature = CURVATURE_STEP * _region_max(
            source_curvature, layer_of_width, width_of_layer,
            x + 0.5 - reach, x + 0.5 + reach, y + 0.5 - reach, y + 0.5 + reach,
        )  # fmt: skip
        value, gx, gy = _value_gradient(source_field, x, y)
        weight = target_weight[j]
        total += weight * value
        g_theta += weight * (gx * qy - gy * qx)
        g_x -= weight * (cos * gx - sin * gy)
        g_y -= weight * (sin * gx + cos * gy)
        error = 0.5 * radius * half_rad * half_rad + half_rad * reach_t
        rest += weight * (math.sqrt(gx * gx + gy * gy) * error + 0.5 * curvature * reach * reach)
    linear = half_rad * abs(g_theta) + half * (abs(g_x) + abs(g_y))
    return total, total + linear + rest


@njit(cache=True, nogil=True)
def bound_boxes(
    boxes: FloatArray, parent_bound: FloatArray, half_rad: float, half: float, threshold: float,
    is_smooth: bool, is_swept: bool,
    source: FloatArray, source_weight: FloatArray, target_field: FloatGrid,
    target_tables: TableArray, target_curvature: TableArray,
    target: FloatArray, target_weight: FloatArray, source_field: FloatGrid,
    source_tables: TableArray, source_curvature: TableArray,
    center: FloatArray, pad: float, scale: float,
    layer_of_width: IntArray, width_of_layer: IntArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Upper bounds (K,) over boxes (K, 3) [theta, t_x, t_y] of one size, and values (K,) inside.

    ``half_rad`` and ``half`` are the boxes' half-widths. Values are taken at
    the centres, and -inf where only the tables were asked. They are not asked where
    ``is_swept`` says that ``parent_bound`` is already what they say of the boxes themselves.
    """
    bounds = np.empty(boxes.shape[0])
    values = np.full(boxes.shape[0], -np.inf)
    for k in range(boxes.shape[0]):
        theta, t_x, t_y = boxes[k, 0], boxes[k, 1], boxes[k, 2]
        bound = parent_bound[k]
        if not is_swept:
            bound = min(bound, _table_bound(
                theta, t_x, t_y, half_rad, half, threshold, source, source_weight, target_tables,
                target, target_weight, source_tables, center, pad, scale,
                layer_of_width, width_of_layer,
            ))  # fmt: skip
        if is_smooth and bound > threshold:
            values[k], smooth = _smooth_bound(
                theta, t_x, t_y, half_rad, half,
                source, source_weight, target_field, target_curvature,
                target, target_weight, source_field, source_curvature,
                center, pad, layer_of_width, width_of_layer,
            )  # fmt: skip
            bound = min(bound, smooth)
        bounds[k] = bound
    return bounds, values
