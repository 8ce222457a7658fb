# mypy: allow-untyped-defs
"""Compiled expectation and maximisation over pose, noise and number of pairs.

Source and target points are paired one to one, some of them: every set of pairs weighs the product
of its pairs' activities, and `_couple` sums over all sets by belief propagation (the Bethe
approximation of the monomer-dimer model). Pairs within reach are kept as a list sorted by source:
``first`` (m + 1,), then ``partner``, ``dx``, ``dy`` of each pair. ``state`` is theta, x, y, sigma
and the number of pairs.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["expectation_maximisation"]

_CUT = 4.0  # standard deviations beyond which no pair is looked at


@njit(cache=True, nogil=True)
def _first_at_least(target, value):
    low, high = 0, target.shape[0]
    while low < high:
        middle = (low + high) >> 1
        if target[middle, 0] < value:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def _near_pairs(source, target, state, cut, first, partner, dx, dy):
    """List the pairs within `cut`; their number, or -1 where the arrays are too short."""
    cos, sin = math.cos(state[0]), math.sin(state[0])
    count = 0
    for i in range(source.shape[0]):
        px = cos * source[i, 0] - sin * source[i, 1] + state[1]
        py = sin * source[i, 0] + cos * source[i, 1] + state[2]
        for j in range(_first_at_least(target, px - cut), target.shape[0]):
            ex = target[j, 0] - px
            if ex > cut:
                break
            ey = target[j, 1] - py
            if ex * ex + ey * ey > cut * cut:
                continue
            if count == partner.shape[0]:
                return -1
            partner[count], dx[count], dy[count] = j, ex, ey
            count += 1
        first[i + 1] = count
    return count


@njit(cache=True, nogil=True)
def _couple(first, partner, activity, count, probability, free, load, max_sweeps):
    """Log of the sum over all sets of pairs; fills each pair's probability.

    ``free`` and ``load`` are room for the messages: the chance that a target is free without the
    source that asks, and the activity that a target attracts.
    """
    num_sources = first.shape[0] - 1
    free[:count] = 1.0
    for _ in range(max_sweeps):
        for e in range(count):
            load[partner[e]] = 0.0
        for i in range(num_sources):
            total = 1.0
            for e in range(first[i], first[i + 1]):
                total += activity[e] * free[e]
            for e in range(first[i], first[i + 1]):
                # For now the probability holds the message back: the source is free without e.
                probability[e] = 1.0 / (total - activity[e] * free[e])
                load[partner[e]] += activity[e] * probability[e]
        change = 0.0
        for e in range(count):
            message = 1.0 / (1.0 + max(load[partner[e]] - activity[e] * probability[e], 0.0))
            change = max(change, abs(message - free[e]))
            free[e] = message
        if change < 1e-3:
            break
    value = 0.0
    for i in range(num_sources):
        total = 1.0
        for e in range(first[i], first[i + 1]):
            total += activity[e] * free[e]
        value += math.log(total)
    for e in range(count):
        if load[partner[e]] > 0.0:
            value += math.log(1.0 + load[partner[e]])
            load[partner[e]] = 0.0
    for e in range(count):
        ratio = activity[e] * probability[e] * free[e]
        probability[e] = ratio / (1.0 + ratio)
        value -= math.log(1.0 + ratio)
    return value


@njit(cache=True, nogil=True)
def _log_choices(num_source, num_target, num_pairs):
    """Log of the number of ways to choose that many pairs."""
    return (
        math.lgamma(num_source + 1.0)
        - math.lgamma(num_source - num_pairs + 1.0)
        - math.lgamma(num_pairs + 1.0)
        + math.lgamma(num_target + 1.0)
        - math.lgamma(num_target - num_pairs + 1.0)
    )


@njit(cache=True, nogil=True)
def _improve(source, target, first, partner, probability, min_sigma, max_sigma, state):
    """Weighted Procrustes, then noise and number of pairs, into ``state``; how far it moved."""
    total, ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(source.shape[0]):
        for e in range(first[i], first[i + 1]):
            p = probability[e]
            total += p
            ax += p * source[i, 0]
            ay += p * source[i, 1]
            bx += p * target[partner[e], 0]
            by += p * target[partner[e], 1]
    if total < 1e-6:
        return 0.0
    ax, ay, bx, by = ax / total, ay / total, bx / total, by / total
    dot, cross = 0.0, 0.0
    for i in range(source.shape[0]):
        sx, sy = source[i, 0] - ax, source[i, 1] - ay
        for e in range(first[i], first[i + 1]):
            qx, qy = target[partner[e], 0] - bx, target[partner[e], 1] - by
            dot += probability[e] * (sx * qx + sy * qy)
            cross += probability[e] * (sx * qy - sy * qx)
    theta = math.atan2(cross, dot) if dot != 0.0 or cross != 0.0 else state[0]
    cos, sin = math.cos(theta), math.sin(theta)
    x, y = bx - (cos * ax - sin * ay), by - (sin * ax + cos * ay)
    square = 0.0
    for i in range(source.shape[0]):
        px = cos * source[i, 0] - sin * source[i, 1] + x
        py = sin * source[i, 0] + cos * source[i, 1] + y
        for e in range(first[i], first[i + 1]):
            ex, ey = target[partner[e], 0] - px, target[partner[e], 1] - py
            square += probability[e] * (ex * ex + ey * ey)
    sigma = min(max(math.sqrt(square / (2.0 * total)), min_sigma), max_sigma)
    moved = abs(theta - state[0]) + (abs(x - state[1]) + abs(y - state[2])) / max_sigma
    moved += abs(math.log(sigma / state[3]))
    most = 0.98 * min(source.shape[0], target.shape[0])
    state[0], state[1], state[2], state[3] = theta, x, y, sigma
    state[4] = min(max(total, min(0.5, most)), most)
    return moved


@njit(cache=True, nogil=True)
def expectation_maximisation(
    source, source_weights, target, target_weights, area, min_sigma, max_sigma, state, max_steps,
    tolerance, max_sweeps, information,
):  # fmt: skip
    """Iterate ``state`` in place; returns the log-likelihood ratio to "nothing belongs together".

    The weights scale the activities of a point's pairs. ``information`` (3, 3) becomes the
    negative second derivatives in theta, x, y, with the pairs uncertain.
    """
    m, n = source.shape[0], target.shape[0]
    first = np.zeros(m + 1, np.int64)
    room = 16 * m
    partner = np.empty(room, np.int64)
    dx, dy, activity = np.empty(room), np.empty(room), np.empty(room)
    probability, free = np.empty(room), np.empty(room)
    load = np.zeros(n)
    step = 0
    while True:
        sigma, num_pairs = state[3], state[4]
        count = _near_pairs(source, target, state, _CUT * sigma, first, partner, dx, dy)
        while count < 0:
            room *= 2
            partner = np.empty(room, np.int64)
            dx, dy, activity = np.empty(room), np.empty(room), np.empty(room)
            probability, free = np.empty(room), np.empty(room)
            count = _near_pairs(source, target, state, _CUT * sigma, first, partner, dx, dy)
        # The number of pairs that makes itself the likeliest, by Stirling's formula.
        odds = num_pairs / ((m - num_pairs) * (n - num_pairs))
        peak = odds * area / (2.0 * math.pi * sigma * sigma)
        scale = -0.5 / (sigma * sigma)
        for i in range(m):
            for e in range(first[i], first[i + 1]):
                weight = source_weights[i] * target_weights[partner[e]]
                square = dx[e] * dx[e] + dy[e] * dy[e]
                activity[e] = peak * weight * math.exp(scale * square)
        value = _couple(first, partner, activity, count, probability, free, load, max_sweeps)
        value -= num_pairs * math.log(odds) + _log_choices(m, n, num_pairs)
        if step >= max_steps:
            break
        step += 1
        moved = _improve(source, target, first, partner, probability, min_sigma, max_sigma, state)
        if moved < tolerance:
            step = max_steps  # once more, for value and information at the last state
    _observe(source, first, dx, dy, probability, state, information)
    return value


@njit(cache=True, nogil=True)
def _observe(source, first, dx, dy, probability, state, information):
    """Information on theta, x, y: that of the pairs, less what is unknown about who is paired."""
    cos, sin = math.cos(state[0]), math.sin(state[0])
    scale = 1.0 / (state[3] * state[3])
    information[:, :] = 0.0
    for i in range(source.shape[0]):
        rx = cos * source[i, 0] - sin * source[i, 1]
        ry = sin * source[i, 0] + cos * source[i, 1]
        total, mean_x, mean_y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for e in range(first[i], first[i + 1]):
            p = probability[e]
            total += p
            mean_x += p * dx[e]
            mean_y += p * dy[e]
            xx += p * dx[e] * dx[e]
            xy += p * dx[e] * dy[e]
            yy += p * dy[e] * dy[e]
        gx, gy = scale * mean_x, scale * mean_y
        hxx = scale * total - scale * scale * xx + gx * gx
        hyy = scale * total - scale * scale * yy + gy * gy
        hxy = -scale * scale * xy + gx * gy
        information[0, 0] += (
            ry * ry * hxx - 2.0 * rx * ry * hxy + rx * rx * hyy + gx * rx + gy * ry
        )
        information[0, 1] += -ry * hxx + rx * hxy
        information[0, 2] += -ry * hxy + rx * hyy
        information[1, 1] += hxx
        information[1, 2] += hxy
        information[2, 2] += hyy
    information[1, 0], information[2, 0] = information[0, 1], information[0, 2]
    information[2, 1] = information[1, 2]
