"""Compiled sweeps over two maps: bounds of whole tiles of translations, by adding up tables.

A slab is an interval of rotations; a tile is `SIDE` x `SIDE` cells, squares of translations, of
one slab. Positions count cells of the tables; a cell of the translations is ``step`` of them wide.

Under a slab a source point reaches a rectangle of the target's field, and the next cell moves it
by ``step``. So every step-th number of a table of range maxima, from the point's place on, is its
part of the bounds of all cells. The source's field, seen through the inverse motion, is turned
against the cells; so for every slab a table of its own is made over the lattice of
u = y - t, and read backwards, since u falls as t rises.

For reading, tables are cut into *strips*: (..., step, step, C, R, SIDE) by the phases of row and
column, then by column; the ``SIDE`` numbers from that column on lie side by side, rows below each
other, so that a tile's numbers are one run of memory. Strips begin ``SIDE`` cells before the first
number that counts and end as far behind the last: a tile that reaches beyond adds zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["SIDE", "bound_tiles", "cut_strips", "slide_back", "split_tiles", "turned_maxima"]

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]
IntArray = NDArray[np.int64]
SumArray = NDArray[np.float32]
TableArray = NDArray[np.int16]

SIDE = 8
"""Cells along a tile."""


@njit(cache=True, nogil=True)
def cut_strips(table: TableArray, first: int, step: int, strips: TableArray) -> None:
    """Strips (step, step, C, R, SIDE) of one table, whose rows and columns count from ``first``.

    What lies outside of the table is zero.
    """
    num_rows, num_cols = table.shape
    cols, rows = strips.shape[2], strips.shape[3]
    plane = np.empty((rows, cols + SIDE), np.int16)
    for phase_row in range(step):
        for phase_col in range(step):
            begin = first + phase_col
            low = max(0, -(begin // step))  # the first that is not negative
            high = min(cols + SIDE, (num_cols - 1 - begin) // step + 1)
            for k in range(rows):
                row = first + phase_row + k * step
                line = plane[k]
                line[:] = 0
                if 0 <= row < num_rows:
                    for j in range(low, high):
                        line[j] = table[row, begin + j * step]
            for j in range(cols):
                into = strips[phase_row, phase_col, j]
                for k in range(rows):
                    for x in range(SIDE):
                        into[k, x] = plane[k, j + x]


@njit(cache=True, nogil=True, inline="always")
def _clip(low: float, high: float, slope: float, begin: float, end: float) -> tuple[float, float]:
    """The part of [begin, end] where ``slope * u`` is within [low, high]; ends may cross."""
    if abs(slope) < 1e-9:
        return (begin, end) if low <= 1e-6 * end and high >= 1e-6 * begin else (end, begin)
    first, last = low / slope, high / slope
    return max(begin, min(first, last)), min(end, max(first, last))


@njit(cache=True, nogil=True)
def _fill_wide(
    begin: int, end: int, lefts: IndexArray, tops: IndexArray, widths: IndexArray, widest: int,
    tables: TableArray, line: TableArray,
) -> None:  # fmt: skip
    """Greatest values over the squares of a row that are wider than the tables' windows."""
    num_rows, num_cols = tables.shape[1], tables.shape[2]
    for col in range(begin, end):
        left, top, width = lefts[col], tops[col], widths[col]
        if width > widest:
            best = line[col]
            for y in range(top, min(top + width, num_rows), widest):
                for x in range(left, min(left + width, num_cols), widest):
                    best = max(best, tables[-1, y, x])
            line[col] = best


@njit(cache=True, nogil=True)
def turned_maxima(
    theta: float, delta: float, frame: IntArray, scale: float, size: float,
    tables: TableArray, rim: float, center: FloatArray, shift: float,
    layer_of_width: IntArray, slack: float, single: TableArray,
) -> None:  # fmt: skip
    """Bounds of a field over squares of u, turned back by all rotations of a slab.

    ``single`` (n, m) gets those of cells of u, from the row and column in ``frame`` on; cell k
    reaches from k to k + 1, each ``size`` cells of the tables. There are ``scale`` of these to a
    working cell. The field is zero within ``rim`` of the border of its tables.
    """
    num_rows, num_cols = tables.shape[1], tables.shape[2]
    rows, cols = single.shape
    cos, sin = math.cos(theta), math.sin(theta)
    arc, sag = math.sin(min(delta, 0.5 * math.pi)), 1.0 - math.cos(delta)
    corner = math.sqrt(2.0)
    half = 0.5 * size * min(corner, abs(cos) + abs(sin) + corner * delta) + slack
    x0, y0 = scale * (center[0] + shift), scale * (center[1] + shift)
    end_x, end_y = num_cols - 1.0, num_rows - 1.0
    lefts, tops = np.empty(cols, np.int32), np.empty(cols, np.int32)
    widths = np.empty(cols, np.int32)
    flat, stride = tables.ravel(), np.int32(num_cols)
    layers = (layer_of_width * (num_rows * num_cols)).astype(np.int32)
    widest = np.int32(layers.shape[0] - 1)
    first_row, first_col = frame[0], frame[1]
    first_u, last_u = size * first_col, size * (first_col + cols)
    far_u = max(abs(first_u), abs(last_u))
    for row in range(rows):
        uy = size * (first_row + row + 0.5)
        line = single[row]
        line[:] = 0
        # A square can meet the field where its middle, less what it reaches, is inside.
        reach = half + (abs(uy) + far_u) * (arc + sag)
        low, high = _clip(
            rim - reach - x0 - sin * uy, num_cols - rim + reach - x0 - sin * uy, cos,
            first_u, last_u,
        )  # fmt: skip
        low, high = _clip(
            rim - reach - y0 - cos * uy, num_rows - rim + reach - y0 - cos * uy, -sin, low, high
        )
        begin = max(0, math.floor(low / size) - first_col - 1)
        end = min(cols, math.ceil(high / size) - first_col + 1)
        most = np.int32(0)
        for col in range(begin, end):
            ux = first_u + size * (col + 0.5)
            qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
            half_x = half + abs(qy) * arc + abs(qx) * sag
            half_y = half + abs(qx) * arc + abs(qy) * sag
            # Outside of the tables everything is zero; truncation is the floor of the rest.
            left = np.int32(min(max(qx + x0 - half_x, 0.0), end_x))
            top = np.int32(min(max(qy + y0 - half_y, 0.0), end_y))
            right = np.int32(min(max(qx + x0 + half_x, 0.0), end_x))
            bottom = np.int32(min(max(qy + y0 + half_y, 0.0), end_y))
            width = np.int32(max(right - left, bottom - top) + np.int32(1))
            lefts[col], tops[col], widths[col] = left, top, width
            most = max(most, width)
        for col in range(begin, end):
            at = layers[np.uint32(min(widths[col], widest))] + tops[col] * stride + lefts[col]
            line[col] = flat[np.uint32(at)]
        if most > widest:
            _fill_wide(begin, end, lefts, tops, widths, widest, tables, line)


@njit(cache=True, nogil=True)
def slide_back(single: TableArray, step: int, result: TableArray) -> None:
    """Greatest values over windows of ``step + 1`` numbers each way, the last window first.

    ``result`` (n + step, m + step) holds all windows that meet ``single`` (n, m); what is outside
    counts as zero. A growing translation meets them in this order.
    """
    rows, cols = single.shape
    wide = np.empty((rows, cols + step), np.int16)
    padded = np.zeros(cols + 2 * step, np.int16)
    for row in range(rows):
        padded[step : step + cols] = single[row]
        line = wide[row]
        line[:] = padded[: cols + step]
        for ahead in range(1, step + 1):
            other = padded[ahead : ahead + cols + step]
            for col in range(cols + step):
                line[col] = max(line[col], other[col])
    best = np.empty(cols + step, np.int16)
    for k in range(rows + step):
        low = rows - 1 - k
        begin, end = max(low, 0), min(low + step, rows - 1)
        best[:] = wide[begin]
        for row in range(begin + 1, end + 1):
            other = wide[row]
            for col in range(cols + step):
                best[col] = max(best[col], other[col])
        if low < 0 or low + step >= rows:
            for col in range(cols + step):
                best[col] = max(best[col], 0)
        into = result[k]
        for col in range(cols + step):
            into[col] = best[cols + step - 1 - col]


@njit(cache=True, nogil=True)
def _frame(
    theta: float, delta: float, bounds: FloatArray, low: FloatArray, high: FloatArray,
    scale: float, frame: IntArray,
) -> None:  # fmt: skip
    """First row and column, and numbers of both, of the table cells of u that a slab needs.

    Those are where the field is not zero, inside ``bounds`` [x, y, x, y] about the center, as far
    as they are in [``low``, ``high``] (2,).
    """
    cos, sin = math.cos(theta), math.sin(theta)
    far = 0.0
    min_x, max_x, min_y, max_y = np.inf, -np.inf, np.inf, -np.inf
    for k in range(4):
        qx, qy = bounds[2 * (k & 1)], bounds[2 * (k >> 1) + 1]
        ux, uy = cos * qx - sin * qy, sin * qx + cos * qy
        far = max(far, math.sqrt(qx * qx + qy * qy))
        min_x, max_x = min(min_x, ux), max(max_x, ux)
        min_y, max_y = min(min_y, uy), max(max_y, uy)
    reach = far * min(delta, 2.0)  # no farther does a turn take it
    begin_x = math.floor(scale * max(min_x - reach, low[0])) - 1
    begin_y = math.floor(scale * max(min_y - reach, low[1])) - 1
    frame[0], frame[1] = begin_y, begin_x
    frame[2] = max(1, math.ceil(scale * min(max_y + reach, high[1])) + 1 - begin_y)
    frame[3] = max(1, math.ceil(scale * min(max_x + reach, high[0])) + 1 - begin_x)


@njit(cache=True, nogil=True)
def _forward_places(
    theta: float, delta: float, half: float, origin: FloatArray,
    points: FloatArray, weights: FloatArray, shift: float, scale: float, unit: float,
    layer_of_width: IntArray, slot_of_layer: IntArray, first: int, step: int, slack: float,
    places: IntArray, factors: SumArray,
) -> float:  # fmt: skip
    """Slot, phases, column and row of each point's numbers for the first cell; see `bound_tiles`.

    Points whose rectangles are wider than the tables have slot -1; their weights are returned.
    """
    cos, sin = math.cos(theta), math.sin(theta)
    arc, sag = math.sin(min(delta, 0.5 * math.pi)), 1.0 - math.cos(delta)
    left_out = 0.0
    for i in range(points.shape[0]):
        px = cos * points[i, 0] - sin * points[i, 1]
        py = sin * points[i, 0] + cos * points[i, 1]
        half_x = half + abs(py) * arc + abs(px) * sag + slack
        half_y = half + abs(px) * arc + abs(py) * sag + slack
        x, y = px + origin[0] + shift, py + origin[1] + shift
        col, row = math.floor(scale * (x - half_x)), math.floor(scale * (y - half_y))
        width = max(math.floor(scale * (x + half_x)) - col, math.floor(scale * (y + half_y)) - row)
        slot = -1
        if width + 1 < layer_of_width.shape[0]:
            slot = slot_of_layer[layer_of_width[width + 1]]
        factors[i] = weights[i] * unit
        if slot < 0:
            left_out += weights[i]
        places[i, 0] = slot
        places[i, 1], places[i, 2] = (row - first) % step, (col - first) % step
        places[i, 3], places[i, 4] = (col - first) // step, (row - first) // step
    return left_out


@njit(cache=True, nogil=True)
def _inverse_places(
    half: float, origin: FloatArray, points: FloatArray, scale: float, frame: IntArray, step: int,
    places: IntArray,
) -> None:  # fmt: skip
    """The same for the target's points in the strips of `slide_back`."""
    for j in range(points.shape[0]):
        for axis in range(2):
            low = math.floor(scale * (points[j, axis] - origin[axis] - half))
            window = frame[1 - axis] + frame[3 - axis] - 1 - low
            # Strips begin a tile before the first window.
            places[j, 2 - axis] = window % step
            places[j, 3 + axis] = window // step + SIDE
        places[j, 0] = 0


@njit(cache=True, nogil=True, inline="always")
def _collect(
    places: IntArray, factors: SumArray, tile_row: int, tile_col: int,
    step: int, cols: int, rows: int, starts: IntArray, weights: SumArray,
) -> int:  # fmt: skip
    """Where the numbers of a tile start, for the points that do not add zero; their number."""
    count = 0
    for i in range(places.shape[0]):
        col, row = places[i, 3] + SIDE * tile_col, places[i, 4] + SIDE * tile_row
        if places[i, 0] >= 0 and 0 <= col < cols and 0 <= row <= rows - SIDE:
            phase = (places[i, 0] * step + places[i, 1]) * step + places[i, 2]
            starts[count] = ((phase * cols + col) * rows + row) * SIDE
            weights[count] = factors[i]
            count += 1
    return count


@njit(cache=True, nogil=True, inline="always")
def _add(
    flat: TableArray, starts: IntArray, weights: SumArray, count: int, total: SumArray
) -> None:
    """Add the numbers of a tile, four points at a time."""
    size = SIDE * SIDE
    for k in range(0, count - 3, 4):
        w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        a, b = flat[starts[k] : starts[k] + size], flat[starts[k + 1] : starts[k + 1] + size]
        c, d = (
            flat[starts[k + 2] : starts[k + 2] + size],
            flat[starts[k + 3] : starts[k + 3] + size],
        )
        for x in range(SIDE * SIDE):
            total[x] += (w0 * np.float32(a[x]) + w1 * np.float32(b[x])) + (
                w2 * np.float32(c[x]) + w3 * np.float32(d[x])
            )
    for k in range(count - count % 4, count):
        w, a = weights[k], flat[starts[k] : starts[k] + size]
        for x in range(SIDE * SIDE):
            total[x] += w * np.float32(a[x])


@njit(cache=True, nogil=True)
def _needed(
    tiles: IntArray, begin: int, origin: FloatArray, half: float, target: FloatArray,
    low: FloatArray, high: FloatArray,
) -> None:  # fmt: skip
    """Least and greatest u = y - t (2,) of the target's points and the tiles of one slab."""
    low[:], high[:] = np.inf, -np.inf
    for j in range(target.shape[0]):
        for axis in range(2):
            low[axis] = min(low[axis], target[j, axis])
            high[axis] = max(high[axis], target[j, axis])
    for axis in range(2):
        first, last, k = tiles[begin, 2 - axis], tiles[begin, 2 - axis], begin
        while k < tiles.shape[0] and tiles[k, 0] == tiles[begin, 0]:
            first, last = min(first, tiles[k, 2 - axis]), max(last, tiles[k, 2 - axis])
            k += 1
        low[axis] -= origin[axis] + half * (2 * SIDE * (last + 1) - 1)
        high[axis] -= origin[axis] + half * (2 * SIDE * first - 1)


@njit(cache=True, nogil=True)
def bound_tiles(
    tiles: IntArray, parents: IntArray, parent_sums: SumArray, sums: SumArray, threshold: float,
    first_theta: float, delta: float, half: float, origin: FloatArray, shape: IntArray,
    source: FloatArray, source_weights: FloatArray, strips: TableArray, first: int,
    slot_of_layer: IntArray,
    target: FloatArray, target_weights: FloatArray, tables: TableArray, rim: float,
    bounds: FloatArray, center: FloatArray, shift: float, scale: float, size: float, unit: float,
    layer_of_width: IntArray, step: int, margin: float, slack: float,
) -> None:  # fmt: skip
    """Bounds of all cells of some tiles (K, 3) [slab, row, column] into ``sums`` (K, SIDE^2).

    A slab's rotations are ``delta`` around ``first_theta + 2 slab delta``, a cell's translations
    ``half`` around ``origin`` plus column and row times its width; ``shape`` holds the numbers of
    rows and columns of cells. Cells outside, and those of which ``parent_sums``, at ``parents``
    (K,), says that they are not above ``threshold``, get -inf. ``strips`` (L, step, step, C, R,
    SIDE) are those of the target's tables, by slots of their layers, ``tables`` the source's.
    Both have ``scale`` cells to a working cell, the lattice of u one for ``size`` of these.
    ``unit`` is what a table counts in; ``margin`` is added for what float32 may round away;
    ``slack`` widens regions for what double precision may.
    """
    num_source, num_target = source.shape[0], target.shape[0]
    places, factors = np.empty((num_source, 5), np.int64), np.empty(num_source, np.float32)
    inverse, inverse_factors = (
        np.empty((num_target, 5), np.int64),
        np.empty(num_target, np.float32),
    )
    starts = np.empty(max(num_source, num_target), np.int64)
    weights = np.empty(max(num_source, num_target), np.float32)
    frame = np.empty(4, np.int64)
    nearest, farthest = np.empty(2), np.empty(2)
    for j in range(num_target):
        inverse_factors[j] = target_weights[j] * unit
    flat, turned_flat = strips.ravel(), np.empty(0, np.int16)
    turned_cols, turned_rows = 0, 0
    stride = round(step / size)
    slab, left_out = -1, 0.0
    for k in range(tiles.shape[0]):
        if tiles[k, 0] != slab:
            slab = tiles[k, 0]
            theta = first_theta + 2.0 * slab * delta
            left_out = _forward_places(
                theta, delta, half, origin, source, source_weights, shift, scale, unit,
                layer_of_width, slot_of_layer, first, step, slack, places, factors,
            )  # fmt: skip
            _needed(tiles, k, origin, half, target, nearest, farthest)
            _frame(theta, delta, bounds, nearest, farthest, scale / size, frame)
            single = np.empty((frame[2], frame[3]), np.int16)
            turned_maxima(
                theta, delta, frame, scale, size, tables, rim, center, shift, layer_of_width,
                slack, single,
            )  # fmt: skip
            turned = np.empty((frame[2] + stride, frame[3] + stride), np.int16)
            slide_back(single, stride, turned)
            turned_rows = (frame[2] - 1) // stride + 2 + 2 * SIDE
            turned_cols = (frame[3] - 1) // stride + 2 + SIDE
            size_strips = stride * stride * turned_cols * turned_rows * SIDE
            if len(turned_flat) < size_strips:
                turned_flat = np.empty(size_strips + size_strips // 2, np.int16)
            turned_strips = turned_flat[:size_strips].reshape(
                (stride, stride, turned_cols, turned_rows, SIDE)
            )
            cut_strips(turned, -SIDE * stride, stride, turned_strips)
            _inverse_places(half, origin, target, scale / size, frame, stride, inverse)
        row, col = tiles[k, 1], tiles[k, 2]
        total = sums[k]
        total[:] = np.float32(left_out + margin)
        count = _collect(
            places, factors, row, col, step, strips.shape[3], strips.shape[4], starts, weights
        )
        _add(flat, starts, weights, count, total)
        count = _collect(
            inverse, inverse_factors, row, col, stride, turned_cols, turned_rows, starts, weights
        )
        _add(turned_flat, starts, weights, count, total)
        parent = parent_sums[parents[k]]
        first_row, first_col = SIDE // 2 * (row & 1), SIDE // 2 * (col & 1)
        for y in range(SIDE):
            for x in range(SIDE):
                above = parent[SIDE * (first_row + y // 2) + first_col + x // 2]
                at = SIDE * y + x
                is_inside = SIDE * row + y < shape[0] and SIDE * col + x < shape[1]
                total[at] = min(total[at], above) if is_inside and above > threshold else -np.inf


@njit(cache=True, nogil=True)
def split_tiles(
    tiles: IntArray, sums: SumArray, threshold: float, turns: int, children: IntArray,
    parents: IntArray,
) -> int:  # fmt: skip
    """Tiles of the next level, by slab, around the cells above ``threshold``; their number.

    ``children`` (4 turns K, 3) have half the cells, and one of ``turns`` parts of the slab;
    ``parents`` (4 turns K,) are the indices of the tiles that they lie in.
    """
    count, begin, half = 0, 0, SIDE // 2
    while begin < tiles.shape[0]:
        end = begin
        while end < tiles.shape[0] and tiles[end, 0] == tiles[begin, 0]:
            end += 1
        for turn in range(turns):
            for k in range(begin, end):
                for part in range(4):
                    row, col = part >> 1, part & 1
                    is_open = False
                    for y in range(half * row, half * row + half):
                        for x in range(half * col, half * col + half):
                            is_open |= sums[k, SIDE * y + x] > threshold
                    if is_open:
                        children[count, 0] = turns * tiles[k, 0] + turn
                        children[count, 1] = 2 * tiles[k, 1] + row
                        children[count, 2] = 2 * tiles[k, 2] + col
                        parents[count] = k
                        count += 1
        begin = end
    return count
