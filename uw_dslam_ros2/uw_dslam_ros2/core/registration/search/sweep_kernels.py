# mypy: allow-untyped-defs
"""Compiled sweeps: bounds of all translations of one slab of rotations, by adding up tables.

A slab is an interval of rotations. Under it a point reaches a rectangle of its field, and moving
the whole slab by one cell of the translations moves that rectangle by as much. So a table of the
field's largest value over rectangles of one size, read from the point's place on, *is* the point's
part of the bounds of all translations, and bounding them is adding up rows of memory.

Places are counted in *bases* of ``base`` cells of the field each; a cell of the translations is
two bases wide. ``tables`` (N, N, 2, 2, rows, columns) go by the size of the rectangle along y and
x, from `SMALLEST` bases on, by the parity of its first base, and then by every second base.
``points`` (4, K) and ``frame`` (origin x, y, pitch, rounding) are the
search's. ``nodes`` (M, 5): slab, first row, end row, first column, end column of translations.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["SMALLEST", "add_slabs", "fill_boxes", "fill_tables", "highest", "split_nodes"]

SMALLEST = 3  # bases that two bases can touch, at least


@njit(cache=True, nogil=True)
def _fill_lattice(window, base, pad, lattice):
    """Largest value of ``window`` (R, C), of cells, in every base, after `pad` bases of zeros."""
    line = np.empty(window.shape[1], np.float32)
    for row in range(0, window.shape[0], base):
        line[:] = window[row]
        for k in range(row + 1, min(row + base, window.shape[0])):
            other = window[k]
            for col in range(line.shape[0]):
                line[col] = max(line[col], other[col])
        into = lattice[pad + row // base, pad:]
        for at in range((line.shape[0] - 1) // base + 1):
            value = line[at * base]
            for col in range(at * base + 1, min((at + 1) * base, line.shape[0])):
                value = max(value, line[col])
            into[at] = value


@njit(cache=True, nogil=True)
def fill_tables(window, base, pad, tables):
    """Largest values of ``window`` (R, C), of cells, over rectangles of bases; zero outside.

    ``pad`` bases of zeros come before the first, an even number, and at least one after the last.
    """
    num, rows, cols = tables.shape[0], 2 * tables.shape[4], tables.shape[5]
    lattice = np.zeros((rows, 2 * cols), np.float32)
    _fill_lattice(window, base, pad, lattice)
    # Even and odd columns apart, and zeros behind them for what is looked up beyond the last.
    room = cols + num + SMALLEST
    tall = np.zeros((rows, 2, room), np.float32)
    for row in range(rows):
        even, odd, line = tall[row, 0], tall[row, 1], lattice[row]
        for col in range(cols):
            even[col], odd[col] = line[2 * col], line[2 * col + 1]
    single = tall.copy()
    for ky in range(num):
        # The last row is zero, so what is cut off beyond it changes nothing.
        for k in range(SMALLEST + ky - 1 if ky else 1, SMALLEST + ky):
            for row in range(rows - k):
                for parity in range(2):
                    line, other = tall[row, parity], single[row + k, parity]
                    for col in range(room):
                        line[col] = max(line[col], other[col])
        for row in range(rows):
            for parity in range(2):
                first = tall[row, parity]
                second, third = tall[row, 1 - parity, parity:], tall[row, parity, 1:]
                into = tables[ky, 0, row & 1, parity, row >> 1]
                for col in range(cols):
                    into[col] = max(first[col], max(second[col], third[col]))
                for kx in range(1, num):
                    # The base that the rectangle of this size has more than the last one.
                    ahead = SMALLEST + kx - 1 + parity
                    more, below = tall[row, ahead & 1, ahead >> 1 :], into
                    into = tables[ky, kx, row & 1, parity, row >> 1]
                    for col in range(cols):
                        into[col] = max(below[col], more[col])


@njit(cache=True, nogil=True)
def _find_places(points, frame, base, pad, theta, delta, origin, num, places, weights):
    """Where each point's table starts for the cell around ``origin``.

    ``places`` (K, 4): size along y times `num` plus that along x, parities, row, column. Points
    whose rectangles are larger than the tables go are left out. Returns the sum of their weights
    and the number of the others.
    """
    swing = math.sin(delta) if delta < 0.5 * math.pi else 1.0
    bow = 0.5 * (1.0 - math.cos(min(delta, math.pi)))
    scale, reach = 1.0 / (frame[2] * base), 1.0 + frame[3] / base
    shift_x = (origin[0] - frame[0]) * scale + 0.5 / base
    shift_y = (origin[1] - frame[1]) * scale + 0.5 / base
    c, s = math.cos(theta) * scale, math.sin(theta) * scale
    left_out, count = 0.0, 0
    for k in range(points.shape[1]):
        rx, ry = c * points[0, k] - s * points[1, k], s * points[0, k] + c * points[1, k]
        u, v = (1.0 - bow) * rx + shift_x, (1.0 - bow) * ry + shift_y
        half_x = reach + swing * abs(ry) + bow * abs(rx)
        half_y = reach + swing * abs(rx) + bow * abs(ry)
        i, j = math.floor(u - half_x), math.floor(v - half_y)
        nx = math.floor(u + half_x) - i + 1 - SMALLEST
        ny = math.floor(v + half_y) - j + 1 - SMALLEST
        if nx >= num or ny >= num:
            left_out += points[2, k]
            continue
        i, j = i + pad, j + pad
        places[count, 0] = ny * num + nx
        places[count, 1] = 2 * (j & 1) + (i & 1)
        places[count, 2], places[count, 3] = j >> 1, i >> 1
        weights[count] = points[2, k]
        count += 1
    return left_out, count


@njit(cache=True, nogil=True)
def add_slabs(
    points, frame, tables, base, pad, maximum, slack, first_theta, delta, origin, nodes, offsets,
    sums,
):  # fmt: skip
    """Bounds of all cells of some nodes into ``sums``, flat, each node's from its offset on.

    A slab's rotation is ``first_theta + 2 slab delta``, a cell's translation ``origin`` plus
    column and row times its width. ``maximum`` bounds the field; ``slack`` is added to all bounds,
    for what float32 may round away.
    """
    num, rows, cols = tables.shape[0], tables.shape[4], tables.shape[5]
    flat, size = tables.ravel(), rows * cols
    places = np.empty((points.shape[1], 4), np.int64)
    weights = np.empty(points.shape[1], np.float32)
    starts = np.empty(4, np.int64)
    slab, left_out, count = -1, 0.0, 0
    for n in range(nodes.shape[0]):
        if nodes[n, 0] != slab:
            slab = nodes[n, 0]
            theta = first_theta + 2.0 * slab * delta
            left_out, count = _find_places(
                points, frame, base, pad, theta, delta, origin, num, places, weights
            )
        j0, i0 = nodes[n, 1], nodes[n, 3]
        height, width = nodes[n, 2] - j0, nodes[n, 4] - i0
        total = sums[offsets[n] : offsets[n + 1]]
        total[:] = np.float32(left_out * maximum + slack)
        k = 0
        while k < count:
            # Four points at once where none of their tables ends inside the node.
            is_inside = k + 4 <= count
            if is_inside:
                for q in range(4):
                    row, col = places[k + q, 2] + j0, places[k + q, 3] + i0
                    is_inside &= row >= 0 and col >= 0
                    is_inside &= row + height <= rows and col + width <= cols
                    table = 4 * places[k + q, 0] + places[k + q, 1]
                    starts[q] = table * size + row * cols + col
            if is_inside:
                w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
                for y in range(height):
                    line = total[y * width : (y + 1) * width]
                    at = y * cols
                    a = flat[starts[0] + at : starts[0] + at + width]
                    b = flat[starts[1] + at : starts[1] + at + width]
                    c = flat[starts[2] + at : starts[2] + at + width]
                    d = flat[starts[3] + at : starts[3] + at + width]
                    for x in range(width):
                        line[x] += (w0 * a[x] + w1 * b[x]) + (w2 * c[x] + w3 * d[x])
                k += 4
                continue
            row, col = places[k, 2] + j0, places[k, 3] + i0
            first_y, end_y = max(0, -row), min(height, rows - row)
            first_x, end_x = max(0, -col), min(width, cols - col)
            if first_x < end_x:
                w, table = weights[k], 4 * places[k, 0] + places[k, 1]
                start = table * size + row * cols + col + first_x
                for y in range(first_y, end_y):
                    line = total[y * width + first_x : y * width + end_x]
                    a = flat[start + y * cols : start + y * cols + end_x - first_x]
                    for x in range(end_x - first_x):
                        line[x] += w * a[x]
            k += 1


@njit(cache=True, nogil=True)
def highest(sums, cells):
    """Indices of the highest sums into ``cells`` (K,), highest first."""
    count = 0
    for at in range(sums.shape[0]):
        if count == cells.shape[0] and sums[at] <= sums[cells[count - 1]]:
            continue
        k = min(count, cells.shape[0] - 1)
        while k > 0 and sums[at] > sums[cells[k - 1]]:
            cells[k] = cells[k - 1]
            k -= 1
        cells[k] = at
        count = min(count + 1, cells.shape[0])


@njit(cache=True, nogil=True)
def fill_boxes(cells, nodes, offsets, first_theta, delta, origin, half_m, boxes):
    """Boxes (K, 6) of cells (K,), which are given by their index in all sums."""
    for k in range(cells.shape[0]):
        n = np.searchsorted(offsets, cells[k], side="right") - 1
        at, width = cells[k] - offsets[n], nodes[n, 4] - nodes[n, 3]
        boxes[k, 0] = first_theta + 2.0 * nodes[n, 0] * delta
        boxes[k, 1] = origin[0] + 2.0 * half_m * (nodes[n, 3] + at % width)
        boxes[k, 2] = origin[1] + 2.0 * half_m * (nodes[n, 1] + at // width)
        boxes[k, 3] = delta
        boxes[k, 4], boxes[k, 5] = half_m, half_m


@njit(cache=True, nogil=True)
def split_nodes(nodes, offsets, sums, floor, num_turns, children):
    """Nodes of the next level around the cells above `floor`; their number.

    ``children`` (num_turns M, 5). Each child holds one of `num_turns` parts of the slab, and the
    rectangle around those cells, each of them cut in four.
    """
    count = 0
    for n in range(nodes.shape[0]):
        j0, i0, width = nodes[n, 1], nodes[n, 3], nodes[n, 4] - nodes[n, 3]
        low_x, high_x, low_y, high_y = width, -1, nodes[n, 2] - j0, -1
        for y in range(nodes[n, 2] - j0):
            line = sums[offsets[n] + y * width : offsets[n] + (y + 1) * width]
            for x in range(width):
                if line[x] > floor:
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), y
        if high_x < 0:
            continue
        for turn in range(num_turns):
            children[count, 0] = num_turns * nodes[n, 0] + turn
            children[count, 1], children[count, 2] = 2 * (j0 + low_y), 2 * (j0 + high_y + 1)
            children[count, 3], children[count, 4] = 2 * (i0 + low_x), 2 * (i0 + high_x + 1)
            count += 1
    return count
