"""Compiled loops of occupancy mapping.

Evidence is an integer, so that sums do not depend on order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["NUM_DIRECTIONS", "add_ping", "beam_table", "diamond", "resample_add"]

NUM_DIRECTIONS = 16384


@njit(cache=True, nogil=True)
def diamond(x, y):  # type: ignore[no-untyped-def]
    """A cheap substitute of atan2 that rises with it, from -2 to 2."""
    size = abs(x) + abs(y)
    if size == 0.0:
        return 0.0
    if x >= 0.0:
        return y / size
    return 2.0 - y / size if y >= 0.0 else -2.0 - y / size


@njit(cache=True, nogil=True)
def beam_table(bearing, half_width, num_directions):  # type: ignore[no-untyped-def]
    """Nearest beam of every direction (diamond angle), -1: none within `half_width` [rad]."""
    table = np.full(num_directions, -1, np.int32)
    best = np.full(num_directions, np.inf)
    step = 4.0 / num_directions
    for b in range(bearing.shape[0]):
        # A quarter turn is one diamond unit; the two differ by at most pi / 2 in scale.
        low = diamond(np.cos(bearing[b] - half_width), np.sin(bearing[b] - half_width))
        high = diamond(np.cos(bearing[b] + half_width), np.sin(bearing[b] + half_width))
        here = diamond(np.cos(bearing[b]), np.sin(bearing[b]))
        first = int(np.floor((low + 2.0) / step))
        last = int(np.floor((high + 2.0) / step))
        if last < first:
            last += num_directions
        for k in range(first, last + 1):
            slot = k % num_directions
            away = abs((slot + 0.5) * step - 2.0 - here)
            away = min(away, 4.0 - away)
            if away < best[slot]:
                best[slot] = away
                table[slot] = b
    return table


@njit(cache=True, nogil=True)
def _add_water(  # type: ignore[no-untyped-def]
    evidence, observed, origin_row, origin_col, resolution, sonar_x, sonar_y, cos, sin,
    table, free_range, free, echo, first_row, first_col,
):  # fmt: skip
    """Take `free` from every cell that a beam crosses before its free range, echoes excepted."""
    num_rows, num_cols = evidence.shape
    num_directions = table.shape[0]
    scale = num_directions / 4.0
    squares = free_range * free_range
    reach = 0.0
    low_x = high_x = sonar_x
    low_y = high_y = sonar_y
    for k in range(num_directions):
        if table[k] >= 0:
            rng = free_range[table[k]]
            reach = max(reach, rng)
            # Back from the diamond angle to a direction.
            p = (k + 0.5) / scale - 2.0
            ux = 1.0 - abs(p)
            uy = p if abs(p) <= 1.0 else np.sign(p) * (2.0 - abs(p))
            size = rng / np.sqrt(ux * ux + uy * uy)
            px, py = sonar_x + (cos * ux - sin * uy) * size, sonar_y + (sin * ux + cos * uy) * size
            low_x, high_x = min(low_x, px), max(high_x, px)
            low_y, high_y = min(low_y, py), max(high_y, py)
    r0 = max(0, int(np.floor(low_y / resolution)) - 1 - origin_row)
    r1 = min(num_rows - 1, int(np.floor(high_y / resolution)) + 1 - origin_row)
    for row in range(r0, r1 + 1):
        dy = (origin_row + row + 0.5) * resolution - sonar_y
        if abs(dy) >= reach:
            continue
        chord = np.sqrt(reach * reach - dy * dy)
        left, right = (
            max(low_x - resolution, sonar_x - chord),
            min(high_x + resolution, sonar_x + chord),
        )
        c0 = max(0, int(np.floor(left / resolution)) - origin_col)
        c1 = min(num_cols - 1, int(np.floor(right / resolution)) - origin_col)
        echo_row = row - first_row
        has_echo = 0 <= echo_row < echo.shape[0]
        for col in range(c0, c1 + 1):
            dx = (origin_col + col + 0.5) * resolution - sonar_x
            lx, ly = cos * dx + sin * dy, -sin * dx + cos * dy
            beam = table[min(int((diamond(lx, ly) + 2.0) * scale), num_directions - 1)]
            if beam >= 0 and dx * dx + dy * dy < squares[beam]:
                echo_col = col - first_col
                if has_echo and 0 <= echo_col < echo.shape[1] and echo[echo_row, echo_col] > 0:
                    continue
                evidence[row, col] -= free
                observed[row, col] = True


@njit(cache=True, nogil=True)
def add_ping(  # type: ignore[no-untyped-def]
    evidence, observed, origin_row, origin_col, resolution,
    sonar_x, sonar_y, sonar_yaw,
    points, weight, sigma_range, beamwidth, max_spread,
    table, free_range, hit, free,
):  # fmt: skip
    """Add one ping's evidence: at most one contribution to each cell, echo before water.

    Points (N, 2) are in the sonar's frame; cell (0, 0) has its outer corner at `origin` cells from
    the frame's zero. Cells outside the grid are left out.
    """
    num_rows, num_cols = evidence.shape
    cos, sin = np.cos(sonar_yaw), np.sin(sonar_yaw)
    count = points.shape[0]
    axes = np.empty((count, 6))  # of each echo: place, direction, spread along and across
    low_x = high_x = sonar_x
    low_y = high_y = sonar_y
    for i in range(count):
        rng = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        ux, uy = (points[i, 0] / rng, points[i, 1] / rng) if rng > 0.0 else (1.0, 0.0)
        axes[i, 0] = sonar_x + cos * points[i, 0] - sin * points[i, 1]
        axes[i, 1] = sonar_y + sin * points[i, 0] + cos * points[i, 1]
        axes[i, 2], axes[i, 3] = cos * ux - sin * uy, sin * ux + cos * uy
        # The echo lies on an arc: sharp in range, as wide as the beam across. At least half a
        # cell, so that it shows.
        axes[i, 4] = max(sigma_range, 0.5 * resolution)
        axes[i, 5] = max(min(0.5 * beamwidth * rng, max_spread), 0.5 * resolution)
        span = 2.0 * max(axes[i, 4], axes[i, 5])
        low_x, high_x = min(low_x, axes[i, 0] - span), max(high_x, axes[i, 0] + span)
        low_y, high_y = min(low_y, axes[i, 1] - span), max(high_y, axes[i, 1] + span)
    first_col = max(0, int(np.floor(low_x / resolution)) - origin_col)
    last_col = min(num_cols - 1, int(np.floor(high_x / resolution)) - origin_col)
    first_row = max(0, int(np.floor(low_y / resolution)) - origin_row)
    last_row = min(num_rows - 1, int(np.floor(high_y / resolution)) - origin_row)
    height, width = max(0, last_row - first_row + 1), max(0, last_col - first_col + 1)
    echo = np.zeros((height, width), np.int32)
    for i in range(count):
        px, py, ax, ay = axes[i, 0], axes[i, 1], axes[i, 2], axes[i, 3]
        span = 2.0 * max(axes[i, 4], axes[i, 5])
        c0 = max(first_col, int(np.floor((px - span) / resolution)) - origin_col)
        c1 = min(last_col, int(np.floor((px + span) / resolution)) - origin_col)
        r0 = max(first_row, int(np.floor((py - span) / resolution)) - origin_row)
        r1 = min(last_row, int(np.floor((py + span) / resolution)) - origin_row)
        own_row = int(np.floor(py / resolution)) - origin_row
        own_col = int(np.floor(px / resolution)) - origin_col
        for row in range(r0, r1 + 1):
            dy = (origin_row + row + 0.5) * resolution - py
            for col in range(c0, c1 + 1):
                dx = (origin_col + col + 0.5) * resolution - px
                along, across = ax * dx + ay * dy, -ay * dx + ax * dy
                size = (along / axes[i, 4]) ** 2 + (across / axes[i, 5]) ** 2
                if row == own_row and col == own_col:
                    size = 0.0
                if size < 4.0:
                    value = np.int32(np.rint(hit * weight[i] * np.exp(-0.5 * size)))
                    slot = echo[row - first_row, col - first_col]
                    echo[row - first_row, col - first_col] = max(slot, value)
    _add_water(
        evidence, observed, origin_row, origin_col, resolution, sonar_x, sonar_y, cos, sin,
        table, free_range, free, echo, first_row, first_col,
    )  # fmt: skip
    for row in range(height):
        for col in range(width):
            if echo[row, col] > 0:
                evidence[first_row + row, first_col + col] += echo[row, col]
                observed[first_row + row, first_col + col] = True


@njit(cache=True, nogil=True)
def resample_add(  # type: ignore[no-untyped-def]
    target, target_observed, target_row, target_col,
    source, source_observed, source_row, source_col,
    x, y, yaw, resolution,
):  # fmt: skip
    """Add a grid at pose (x, y, yaw) to the target: each target cell takes its nearest cell."""
    num_rows, num_cols = target.shape
    source_rows, source_cols = source.shape
    cos, sin = np.cos(yaw), np.sin(yaw)
    # Window of the target that the source can reach.
    low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
    for corner in range(4):
        cx = (source_col + (source_cols if corner % 2 else 0)) * resolution
        cy = (source_row + (source_rows if corner // 2 else 0)) * resolution
        px, py = x + cos * cx - sin * cy, y + sin * cx + cos * cy
        low_x, high_x, low_y, high_y = (
            min(low_x, px),
            max(high_x, px),
            min(low_y, py),
            max(high_y, py),
        )
    c0 = max(0, int(np.floor(low_x / resolution)) - target_col)
    c1 = min(num_cols - 1, int(np.floor(high_x / resolution)) - target_col)
    r0 = max(0, int(np.floor(low_y / resolution)) - target_row)
    r1 = min(num_rows - 1, int(np.floor(high_y / resolution)) - target_row)
    for row in range(r0, r1 + 1):
        dy = (target_row + row + 0.5) * resolution - y
        for col in range(c0, c1 + 1):
            dx = (target_col + col + 0.5) * resolution - x
            lx, ly = cos * dx + sin * dy, -sin * dx + cos * dy
            i = int(np.floor(ly / resolution)) - source_row
            j = int(np.floor(lx / resolution)) - source_col
            if 0 <= i < source_rows and 0 <= j < source_cols and source_observed[i, j]:
                target[row, col] += source[i, j]
                target_observed[row, col] = True
