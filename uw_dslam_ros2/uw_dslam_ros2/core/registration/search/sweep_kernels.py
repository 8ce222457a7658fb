"""Compiled sweeps: bounds of whole tiles of translations under a slab of rotations, by adding up.

A slab is an interval of rotations; a tile is `SIDE` x `SIDE` cells, squares of translations, of
one slab. Tables of range maxima have square cells of their own, ``step`` to a cell of the
translations; in them places are counted.

Under a slab the point of a forward term reaches a rectangle of its field, and the next cell of the
translations moves that by ``step``. So every step-th number of a table of maxima over squares that
large, from the point's place on, is its part of the bounds of all cells. The field of an inverse
term is turned against the translations; so every slab gets a table of its own, over the lattice of
u = y - t, and that is read backwards, since u falls as t rises.

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

from uw_dslam_ros2.core.registration.search.tile_kernels import SIDE

__all__ = [
    "add_forward",
    "add_inverse",
    "coarsen",
    "cut_strips",
    "slide_back",
    "widen",
]

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]
IntArray = NDArray[np.int64]
SumArray = NDArray[np.float32]
TableArray = NDArray[np.int16]


@njit(cache=True, nogil=True)
def coarsen(windows: SumArray, size: float, unit: float, pad: int, table: TableArray) -> None:
    """Greatest of ``windows`` (R, C), cells of a field, in cells of a table, in whole ``unit``s.

    A cell of the table is ``size`` of the field's wide. ``pad`` rows and columns of zeros come
    before the first.
    """
    num_rows, num_cols = windows.shape
    rows, cols = table.shape[0] - pad, table.shape[1] - pad
    table[:] = 0
    line = np.empty(num_cols, np.float32)
    scale = 1.0 / unit
    for row in range(rows):
        first, last = math.floor(row * size), min(math.ceil((row + 1) * size), num_rows)
        line[:] = windows[first]
        for k in range(first + 1, last):
            other = windows[k]
            for col in range(num_cols):
                line[col] = max(line[col], other[col])
        for col in range(cols):
            begin, end = math.floor(col * size), min(math.ceil((col + 1) * size), num_cols)
            value = line[begin]
            for k in range(begin + 1, end):
                value = max(value, line[k])
            table[pad + row, pad + col] = math.ceil(value * scale)


@njit(cache=True, nogil=True)
def widen(table: TableArray, more_rows: int, more_cols: int, wide: TableArray) -> None:
    """Greatest of each number and of so many rows and columns behind it, as far as there are."""
    num_rows, num_cols = table.shape
    lines = table.copy()
    for row in range(num_rows):
        line = lines[row]
        for ahead in range(1, min(more_cols + 1, num_cols)):
            other = table[row, ahead:]
            for col in range(num_cols - ahead):
                line[col] = max(line[col], other[col])
    for row in range(num_rows):
        line = wide[row]
        line[:] = lines[row]
        for k in range(row + 1, min(row + more_rows + 1, num_rows)):
            other = lines[k]
            for col in range(num_cols):
                line[col] = max(line[col], other[col])


@njit(cache=True, nogil=True)
def cut_strips(table: TableArray, first: int, step: int, strips: TableArray) -> None:
    """Strips (step, step, C, R, SIDE) of one table, whose rows and columns count from ``first``.

    What lies outside of the table is zero. Four numbers at a time are packed into one to be moved.
    """
    num_rows, num_cols = table.shape
    cols, rows = strips.shape[2], strips.shape[3]
    flat, at = strips.reshape(strips.size).view(np.uint64), 0
    line = np.zeros(cols + 2 * SIDE, np.uint64)
    fours = np.empty((rows, cols + SIDE), np.uint64)
    one, two, three = np.uint64(16), np.uint64(32), np.uint64(48)
    for phase_row in range(step):
        for phase_col in range(step):
            begin = first + phase_col
            low = max(0, -(begin // step))  # the first that is not negative
            high = min(cols + SIDE, (num_cols - 1 - begin) // step + 1)
            line[:] = 0
            for k in range(rows):
                row, four = first + phase_row + k * step, fours[k]
                four[:] = 0
                if 0 <= row < num_rows:
                    for j in range(low, high):
                        line[j] = np.uint16(table[row, begin + j * step])
                    for j in range(cols + SIDE):
                        four[j] = (line[j] | line[j + 1] << one) | (
                            line[j + 2] << two | line[j + 3] << three
                        )
            for j in range(cols):
                for k in range(rows):
                    flat[at], flat[at + 1] = fours[k, j], fours[k, j + 4]
                    at += 2


@njit(cache=True, nogil=True, inline="always")
def _collect(
    places: IntArray, factors: SumArray, count: int, tile_row: int, tile_col: int,
    step: int, cols: int, rows: int, starts: IntArray, weights: SumArray,
) -> int:  # fmt: skip
    """Where the numbers of a tile start, for the points that do not add zero; their number."""
    num = 0
    for k in range(count):
        col, row = places[k, 3] + SIDE * tile_col, places[k, 4] + SIDE * tile_row
        if 0 <= col < cols and 0 <= row <= rows - SIDE:
            phase = (places[k, 0] * step + places[k, 1]) * step + places[k, 2]
            starts[num] = ((phase * cols + col) * rows + row) * SIDE
            weights[num] = factors[k]
            num += 1
    return num


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
def _forward_places(
    theta: float, delta: float, half: float, origin: FloatArray, points: FloatArray,
    first_point: int, frame: FloatArray, size: float, layer_of_width: IntArray,
    slot_of_layer: IntArray, first: int, step: int, unit: float, places: IntArray,
    factors: SumArray,
) -> tuple[int, float]:  # fmt: skip
    """Slot, phases, column and row of each point's numbers for the first cell.

    Points whose rectangles are wider than the tables are left out. Returns the number of the
    others, and the sum of the weights that are left out.
    """
    scale = 1.0 / (frame[2] * size)
    max_sin = math.sin(delta) if delta < 0.5 * math.pi else 1.0
    versine = 0.5 * (1.0 - math.cos(min(delta, math.pi)))
    shift_x = (origin[0] - frame[0]) * scale + 0.5 / size
    shift_y = (origin[1] - frame[1]) * scale + 0.5 / size
    cos, sin, reach = math.cos(theta) * scale, math.sin(theta) * scale, half * scale + frame[3]
    left_out, count = 0.0, 0
    for k in range(places.shape[0]):
        at = first_point + k
        x, y, weight = points[0, at], points[1, at], points[2, at]
        rx, ry = cos * x - sin * y, sin * x + cos * y
        half_x = reach + max_sin * abs(ry) + versine * abs(rx)
        half_y = reach + max_sin * abs(rx) + versine * abs(ry)
        u, v = (1.0 - versine) * rx + shift_x, (1.0 - versine) * ry + shift_y
        col, row = math.floor(u - half_x), math.floor(v - half_y)
        width, height = math.floor(u + half_x) - col + 1, math.floor(v + half_y) - row + 1
        slot = -1
        if max(width, height) < layer_of_width.shape[0]:
            slot = slot_of_layer[layer_of_width[height], layer_of_width[width]]
        if slot < 0:
            left_out += weight
            continue
        col, row = col - first, row - first
        places[count, 0], places[count, 1], places[count, 2] = slot, row % step, col % step
        places[count, 3], places[count, 4] = col // step, row // step
        factors[count] = weight * unit
        count += 1
    return count, left_out


@njit(cache=True, nogil=True)
def add_forward(
    tiles: IntArray, first_theta: float, delta: float, half: float, origin: FloatArray,
    points: FloatArray, begin: int, end: int, frame: FloatArray, size: float, step: int,
    unit: float, layer_of_width: IntArray, slot_of_layer: IntArray, maximum: float, first: int,
    strips: TableArray, sums: SumArray,
) -> None:  # fmt: skip
    """Add what a forward term can bring at most to the cells of tiles (K, 3) [slab, row, column].

    A slab's rotations are ``delta`` around ``first_theta + 2 slab delta``, a cell's translations
    ``half`` around ``origin`` plus column and row times its width. ``points[:, begin:end]`` and
    ``frame`` are the search's. ``strips`` (S, step, step, C, R, SIDE) are found in
    ``slot_of_layer`` by the layers of a rectangle's height and width; they count in ``unit`` and
    from the table's row and column ``first``. A table's cell is ``size`` of the field's wide.
    ``maximum`` bounds the field.
    """
    num = end - begin
    places, factors = np.empty((num, 5), np.int64), np.empty(num, np.float32)
    starts, weights = np.empty(num, np.int64), np.empty(num, np.float32)
    flat, cols, rows = strips.ravel(), strips.shape[3], strips.shape[4]
    slab, count, left_out = -1, 0, 0.0
    for k in range(tiles.shape[0]):
        if tiles[k, 0] != slab:
            slab = tiles[k, 0]
            count, left_out = _forward_places(
                first_theta + 2.0 * slab * delta, delta, half, origin, points, begin, frame, size,
                layer_of_width, slot_of_layer, first, step, unit, places, factors,
            )  # fmt: skip
        total = sums[k]
        total += np.float32(left_out * maximum)
        num = _collect(
            places, factors, count, tiles[k, 1], tiles[k, 2], step, cols, rows, starts, weights
        )
        _add(flat, starts, weights, num, total)


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
    theta: float, delta: float, frame: IntArray, fold: float, tables: TableArray,
    content: FloatArray, shift: FloatArray, layer_of_width: IntArray, slack: float,
    single: TableArray,
) -> None:  # fmt: skip
    """Bounds of a field over squares of u, turned back by all rotations of a slab.

    ``single`` (n, m) gets those of squares of u, ``fold`` cells of the tables wide, from the row
    and column in ``frame`` on. ``shift`` (2,) is the place of the turned point 0 in the tables;
    the field is zero outside of ``content`` [low x, low y, high x, high y].
    """
    num_rows, num_cols = tables.shape[1], tables.shape[2]
    rows, cols = single.shape
    cos, sin = math.cos(theta), math.sin(theta)
    max_sin = math.sin(delta) if delta < 0.5 * math.pi else 1.0
    versine = 0.5 * (1.0 - math.cos(min(delta, math.pi)))
    corner = math.sqrt(2.0)
    half = 0.5 * fold * min(corner, abs(cos) + abs(sin) + corner * delta) + slack
    end_x, end_y = num_cols - 1.0, num_rows - 1.0
    lefts, tops = np.empty(cols, np.int32), np.empty(cols, np.int32)
    widths = np.empty(cols, np.int32)
    flat, stride = tables.ravel(), np.int32(num_cols)
    layers = (layer_of_width * (num_rows * num_cols)).astype(np.int32)
    widest = np.int32(layers.shape[0] - 1)
    while layer_of_width[widest] >= tables.shape[0]:
        widest -= np.int32(1)
    first_row, first_col = frame[0], frame[1]
    first_u, last_u = fold * first_col, fold * (first_col + cols)
    far_u, stay = max(abs(first_u), abs(last_u)), 1.0 - versine
    x0, y0 = shift[0], shift[1]
    for row in range(rows):
        uy = fold * (first_row + row + 0.5)
        line = single[row]
        line[:] = 0
        # A square can meet the field where its middle, less what it reaches, is inside.
        reach = half + (abs(uy) + far_u) * (max_sin + 2.0 * versine)
        low, high = _clip(
            content[0] - reach - x0 - sin * uy, content[2] + reach - x0 - sin * uy, cos,
            first_u, last_u,
        )  # fmt: skip
        low, high = _clip(
            content[1] - reach - y0 - cos * uy, content[3] + reach - y0 - cos * uy, -sin, low, high
        )
        begin = max(0, math.floor(low / fold) - first_col - 1)
        end = min(cols, math.ceil(high / fold) - first_col + 1)
        most = np.int32(0)
        for col in range(begin, end):
            ux = first_u + fold * (col + 0.5)
            qx, qy = cos * ux + sin * uy, cos * uy - sin * ux
            half_x = half + abs(qy) * max_sin + abs(qx) * versine
            half_y = half + abs(qx) * max_sin + abs(qy) * versine
            # Outside of the tables everything is zero; truncation is the floor of the rest.
            x, y = stay * qx + x0, stay * qy + y0
            left = np.int32(min(max(x - half_x, 0.0), end_x))
            top = np.int32(min(max(y - half_y, 0.0), end_y))
            right = np.int32(min(max(x + half_x, 0.0), end_x))
            bottom = np.int32(min(max(y + half_y, 0.0), end_y))
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
def _fill_frame(
    theta: float, delta: float, content: FloatArray, shift: FloatArray, low: FloatArray,
    high: FloatArray, fold: float, frame: IntArray,
) -> None:  # fmt: skip
    """First row and column, and numbers of both, of the squares of u that a slab needs.

    Those are where the field is not zero, as far as they are in [``low``, ``high``] (2,), which
    count cells of the tables.
    """
    cos, sin = math.cos(theta), math.sin(theta)
    far = 0.0
    min_x, max_x, min_y, max_y = np.inf, -np.inf, np.inf, -np.inf
    for k in range(4):
        qx, qy = content[2 * (k & 1)] - shift[0], content[2 * (k >> 1) + 1] - shift[1]
        ux, uy = cos * qx - sin * qy, sin * qx + cos * qy
        far = max(far, math.sqrt(qx * qx + qy * qy))
        min_x, max_x = min(min_x, ux), max(max_x, ux)
        min_y, max_y = min(min_y, uy), max(max_y, uy)
    reach = far * min(delta, 2.0)  # no farther does a turn take it
    begin_x = math.floor(max(min_x - reach, low[0]) / fold) - 1
    begin_y = math.floor(max(min_y - reach, low[1]) / fold) - 1
    frame[0], frame[1] = begin_y, begin_x
    frame[2] = max(1, math.ceil(min(max_y + reach, high[1]) / fold) + 1 - begin_y)
    frame[3] = max(1, math.ceil(min(max_x + reach, high[0]) / fold) + 1 - begin_x)


@njit(cache=True, nogil=True)
def _inverse_places(
    half: float, origin: FloatArray, points: FloatArray, first_point: int, scale: float,
    frame: IntArray, step: int, places: IntArray,
) -> None:  # fmt: skip
    """The same as `_forward_places` for the strips of `slide_back`, squares of u to a metre."""
    for k in range(places.shape[0]):
        for axis in range(2):
            low = math.floor(scale * (points[axis, first_point + k] - origin[axis] - half))
            window = frame[1 - axis] + frame[3 - axis] - 1 - low
            # Strips begin a tile before the first window.
            places[k, 2 - axis] = window % step
            places[k, 3 + axis] = window // step + SIDE
        places[k, 0] = 0


@njit(cache=True, nogil=True)
def _find_needed(
    tiles: IntArray, begin: int, origin: FloatArray, half: float, points: FloatArray, first: int,
    end: int, low: FloatArray, high: FloatArray,
) -> None:  # fmt: skip
    """Least and greatest u = y - t (2,) of an inverse term's points and the tiles of one slab."""
    low[:], high[:] = np.inf, -np.inf
    for k in range(first, end):
        for axis in range(2):
            low[axis] = min(low[axis], points[axis, k])
            high[axis] = max(high[axis], points[axis, k])
    for axis in range(2):
        least, most, k = tiles[begin, 2 - axis], tiles[begin, 2 - axis], begin
        while k < tiles.shape[0] and tiles[k, 0] == tiles[begin, 0]:
            least, most = min(least, tiles[k, 2 - axis]), max(most, tiles[k, 2 - axis])
            k += 1
        low[axis] -= origin[axis] + half * (2 * SIDE * (most + 1) - 1)
        high[axis] -= origin[axis] + half * (2 * SIDE * least - 1)


@njit(cache=True, nogil=True)
def add_inverse(
    tiles: IntArray, first_theta: float, delta: float, half: float, origin: FloatArray,
    points: FloatArray, begin: int, end: int, frame: FloatArray, size: float, step: int,
    unit: float, layer_of_width: IntArray, fold: int, content: FloatArray, tables: TableArray,
    sums: SumArray,
) -> None:  # fmt: skip
    """The same as `add_forward` for an inverse term.

    ``tables`` (L, R, C) are its field's, by layers. The lattice of u has one square for ``fold``
    of their cells.
    """
    num, cell = end - begin, frame[2] * size
    places, factors = np.empty((num, 5), np.int64), np.empty(num, np.float32)
    starts, weights = np.empty(num, np.int64), np.empty(num, np.float32)
    for k in range(num):
        factors[k] = points[2, begin + k] * unit
    shift = np.empty(2)
    shift[0], shift[1] = 0.5 / size - frame[0] / cell, 0.5 / size - frame[1] / cell
    lattice, stride = np.empty(4, np.int64), step // fold
    low, high = np.empty(2), np.empty(2)
    flat, cols, rows, slab = np.empty(0, np.int16), 0, 0, -1
    for k in range(tiles.shape[0]):
        if tiles[k, 0] != slab:
            slab = tiles[k, 0]
            theta = first_theta + 2.0 * slab * delta
            _find_needed(tiles, k, origin, half, points, begin, end, low, high)
            _fill_frame(theta, delta, content, shift, low / cell, high / cell, fold, lattice)
            single = np.empty((lattice[2], lattice[3]), np.int16)
            turned_maxima(
                theta, delta, lattice, fold, tables, content, shift, layer_of_width,
                2.0 * frame[3], single,
            )  # fmt: skip
            turned = np.empty((lattice[2] + stride, lattice[3] + stride), np.int16)
            slide_back(single, stride, turned)
            rows = (lattice[2] - 1) // stride + 2 + 2 * SIDE
            cols = (lattice[3] - 1) // stride + 2 + SIDE
            num_strips = stride * stride * cols * rows * SIDE
            if len(flat) < num_strips:
                flat = np.empty(num_strips + num_strips // 2, np.int16)
            strips = flat[:num_strips].reshape((stride, stride, cols, rows, SIDE))
            cut_strips(turned, -SIDE * stride, stride, strips)
            _inverse_places(
                half, origin, points, begin, 1.0 / (cell * fold), lattice, stride, places
            )
        num = _collect(
            places, factors, end - begin, tiles[k, 1], tiles[k, 2], stride, cols, rows, starts,
            weights,
        )  # fmt: skip
        _add(flat, starts, weights, num, sums[k])
