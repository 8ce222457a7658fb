"""Compiled loops that add pings to a grid.

Evidence is summed in integers, so that sums do not depend on order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["NUM_DIRECTIONS", "add_ping", "beam_table", "diamond"]

NUM_DIRECTIONS = 16384
_SLOTS_PER_BIN = 16
_LONG_RUN, _SHORT_RUN = 32, 8
_REACH = 2.5  # standard deviations, beyond which an echo says nothing


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
def _extremes(limit):  # type: ignore[no-untyped-def]
    """Least and largest of `limit` over runs of bins: entry [j, i] is over 2^j bins from bin i on.

    A bin is `_SLOTS_PER_BIN` directions.
    """
    num_bins = limit.shape[0] // _SLOTS_PER_BIN
    num_levels = 1
    while (1 << num_levels) <= num_bins:
        num_levels += 1
    least = np.empty((num_levels, num_bins))
    most = np.empty((num_levels, num_bins))
    for i in range(num_bins):
        window = limit[i * _SLOTS_PER_BIN : (i + 1) * _SLOTS_PER_BIN]
        least[0, i], most[0, i] = window.min(), window.max()
    for j in range(1, num_levels):
        half = 1 << (j - 1)
        for i in range(num_bins - 2 * half + 1):
            least[j, i] = min(least[j - 1, i], least[j - 1, i + half])
            most[j, i] = max(most[j - 1, i], most[j - 1, i + half])
    return least, most


@njit(cache=True, nogil=True)
def _slot(lx, ly, num_directions):  # type: ignore[no-untyped-def]
    return min(int((diamond(lx, ly) + 2.0) * (num_directions / 4.0)), num_directions - 1)


@njit(cache=True, nogil=True)
def _run_state(dx0, dx1, dy, cos, sin, num_directions, least, most, level_of):  # type: ignore[no-untyped-def]
    """Whether a run of cells in one row is all water (1), all unknown (-1), or not decided (0).

    Along a row the direction from the sonar turns one way only and the distance has its largest
    value at an end, so the ends decide; across the seam behind the sonar nothing is said.
    """
    first = _slot(cos * dx0 + sin * dy, -sin * dx0 + cos * dy, num_directions)
    last = _slot(cos * dx1 + sin * dy, -sin * dx1 + cos * dy, num_directions)
    if abs(first - last) > num_directions // 4:
        return 0
    # One more on each side: a direction between may be rounded past its neighbour.
    low = max(min(first, last) - 1, 0) // _SLOTS_PER_BIN
    high = min(max(first, last) + 1, num_directions - 1) // _SLOTS_PER_BIN
    level = level_of[high - low + 1]
    other = high - (1 << level) + 1
    far = max(dx0 * dx0, dx1 * dx1) + dy * dy
    if far < min(least[level, low], least[level, other]):
        return 1
    near = dy * dy
    if dx0 > 0.0:
        near += dx0 * dx0
    elif dx1 < 0.0:
        near += dx1 * dx1
    if near >= max(most[level, low], most[level, other]):
        return -1
    return 0


@njit(cache=True, nogil=True)
def _water_window(limit, sonar_x, sonar_y, cos, sin):  # type: ignore[no-untyped-def]
    """Largest free range and the box around all free water: low x, high x, low y, high y."""
    num_directions = limit.shape[0]
    reach = 0.0
    low_x = high_x = sonar_x
    low_y = high_y = sonar_y
    for k in range(num_directions):
        if limit[k] > 0.0:
            rng = np.sqrt(limit[k])
            reach = max(reach, rng)
            # Back from the diamond angle to a direction.
            p = (k + 0.5) / (num_directions / 4.0) - 2.0
            ux = 1.0 - abs(p)
            uy = p if abs(p) <= 1.0 else np.sign(p) * (2.0 - abs(p))
            size = rng / np.sqrt(ux * ux + uy * uy)
            px, py = sonar_x + (cos * ux - sin * uy) * size, sonar_y + (sin * ux + cos * uy) * size
            low_x, high_x = min(low_x, px), max(high_x, px)
            low_y, high_y = min(low_y, py), max(high_y, py)
    return reach, low_x, high_x, low_y, high_y


@njit(cache=True, nogil=True)
def _add_water(  # type: ignore[no-untyped-def]
    water, origin_row, origin_col, resolution, sonar_x, sonar_y, cos, sin, limit,
):  # fmt: skip
    """Count one in every cell nearer than its direction's `limit` (a squared range).

    Runs of cells are decided by their ends where possible; the others cell by cell.
    """
    num_rows, num_cols = water.shape
    num_directions = limit.shape[0]
    reach, low_x, high_x, low_y, high_y = _water_window(limit, sonar_x, sonar_y, cos, sin)
    if reach <= 0.0:
        return
    least, most = _extremes(limit)
    level_of = np.zeros(least.shape[1] + 1, np.int64)
    for n in range(2, level_of.shape[0]):
        level_of[n] = level_of[n // 2] + 1
    r0 = max(0, int(np.floor(low_y / resolution)) - 1 - origin_row)
    r1 = min(num_rows - 1, int(np.floor(high_y / resolution)) + 1 - origin_row)
    for row in range(r0, r1 + 1):
        dy = (origin_row + row + 0.5) * resolution - sonar_y
        if abs(dy) >= reach:
            continue
        chord = np.sqrt(reach * reach - dy * dy)
        left = max(low_x - resolution, sonar_x - chord)
        right = min(high_x + resolution, sonar_x + chord)
        c0 = max(0, int(np.floor(left / resolution)) - origin_col)
        c1 = min(num_cols - 1, int(np.floor(right / resolution)) - origin_col)
        start, size = c0, _LONG_RUN
        while start <= c1:
            stop = min(start + size - 1, c1)
            dx0 = (origin_col + start + 0.5) * resolution - sonar_x
            dx1 = (origin_col + stop + 0.5) * resolution - sonar_x
            state = _run_state(dx0, dx1, dy, cos, sin, num_directions, least, most, level_of)
            if state == 0 and size == _LONG_RUN:
                size = _SHORT_RUN
                continue
            if state == 1:
                # A view counted from zero: the compiler then writes many cells at a time.
                run = water[row, start : stop + 1]
                for i in range(run.shape[0]):
                    run[i] += 1
            elif state == 0:
                for col in range(start, stop + 1):
                    dx = (origin_col + col + 0.5) * resolution - sonar_x
                    slot = _slot(cos * dx + sin * dy, -sin * dx + cos * dy, num_directions)
                    if dx * dx + dy * dy < limit[slot]:
                        water[row, col] += 1
            start = stop + 1
            if (start - c0) % _LONG_RUN == 0:
                size = _LONG_RUN


@njit(cache=True, nogil=True)
def add_ping(  # type: ignore[no-untyped-def]
    echoes, water, scratch, origin_row, origin_col, resolution,
    sonar_x, sonar_y, sonar_yaw,
    points, weight, sigma_range, beamwidth, max_spread, least_sigma,
    table, free_range, hit,
):  # fmt: skip
    """Add one ping's evidence: at most one contribution to each cell, echo before water.

    `echoes` (R, C) sums what echoes say, `hit` where a strong one lies; `water` (R, C) counts the
    pings that looked through. Points (N, 2) are in the sonar's frame; cell (0, 0) has its outer
    corner at `origin` cells from the frame's zero. Cells outside the grid are left out.
    `least_sigma` [m] is the least spread of an echo. `scratch` (R, C) int16 is zeros in, zeros
    out; making it anew for each ping would cost more than the ping.
    """
    num_rows, num_cols = echoes.shape
    cos, sin = np.cos(sonar_yaw), np.sin(sonar_yaw)
    limit = np.full(table.shape[0], -1.0)
    for k in range(table.shape[0]):
        if table[k] >= 0:
            limit[k] = free_range[table[k]] * free_range[table[k]]
    _add_water(water, origin_row, origin_col, resolution, sonar_x, sonar_y, cos, sin, limit)
    touched_rows, touched_cols = np.empty(1024, np.int64), np.empty(1024, np.int64)
    num_touched = 0
    for i in range(points.shape[0]):
        rng = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        ux, uy = (points[i, 0] / rng, points[i, 1] / rng) if rng > 0.0 else (1.0, 0.0)
        px = sonar_x + cos * points[i, 0] - sin * points[i, 1]
        py = sonar_y + sin * points[i, 0] + cos * points[i, 1]
        ax, ay = cos * ux - sin * uy, sin * ux + cos * uy
        # The echo lies on an arc: sharp in range, as wide as the beam across.
        sigma_along = max(sigma_range, least_sigma)
        sigma_across = max(min(0.5 * beamwidth * rng, max_spread), least_sigma)
        reach_x = _REACH * np.sqrt((ax * sigma_along) ** 2 + (ay * sigma_across) ** 2)
        reach_y = _REACH * np.sqrt((ay * sigma_along) ** 2 + (ax * sigma_across) ** 2)
        c0 = max(0, int(np.floor((px - reach_x) / resolution)) - origin_col)
        c1 = min(num_cols - 1, int(np.floor((px + reach_x) / resolution)) - origin_col)
        r0 = max(0, int(np.floor((py - reach_y) / resolution)) - origin_row)
        r1 = min(num_rows - 1, int(np.floor((py + reach_y) / resolution)) - origin_row)
        for row in range(r0, r1 + 1):
            dy = (origin_row + row + 0.5) * resolution - py
            for col in range(c0, c1 + 1):
                dx = (origin_col + col + 0.5) * resolution - px
                along, across = ax * dx + ay * dy, -ay * dx + ax * dy
                size = (along / sigma_along) ** 2 + (across / sigma_across) ** 2
                if size >= _REACH * _REACH:
                    continue
                value = np.int32(np.rint(hit * weight[i] * np.exp(-0.5 * size)))
                before = np.int32(scratch[row, col])
                if value <= before:
                    continue
                if before == 0:
                    # An echo here: this ping's water is taken back.
                    wx = (origin_col + col + 0.5) * resolution - sonar_x
                    wy = (origin_row + row + 0.5) * resolution - sonar_y
                    slot = _slot(cos * wx + sin * wy, -sin * wx + cos * wy, limit.shape[0])
                    if wx * wx + wy * wy < limit[slot]:
                        water[row, col] -= 1
                    if num_touched == touched_rows.shape[0]:
                        touched_rows = np.concatenate((touched_rows, np.empty_like(touched_rows)))
                        touched_cols = np.concatenate((touched_cols, np.empty_like(touched_cols)))
                    touched_rows[num_touched], touched_cols[num_touched] = row, col
                    num_touched += 1
                echoes[row, col] += value - before
                scratch[row, col] = value
    for k in range(num_touched):
        scratch[touched_rows[k], touched_cols[k]] = 0
