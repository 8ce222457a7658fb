# mypy: allow-untyped-defs
"""Compiled expectation and maximisation over pose, noise and clutter share."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["expectation_maximisation"]


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
def _expect(source, source_weights, target, target_weights, area, state, partner):
    """Likelihood; per source point the weight of its partner, the partner, and the spread."""
    theta, tx, ty, sigma, share = state[0], state[1], state[2], state[3], state[4]
    cos, sin = math.cos(theta), math.sin(theta)
    cut = 4.5 * sigma
    density = share * area / (target.shape[0] * 2.0 * math.pi * sigma * sigma)
    scale = -0.5 / (sigma * sigma)
    value = 0.0
    for i in range(source.shape[0]):
        px = cos * source[i, 0] - sin * source[i, 1] + tx
        py = sin * source[i, 0] + cos * source[i, 1] + ty
        total, mean_x, mean_y, square = 0.0, 0.0, 0.0, 0.0
        for j in range(_first_at_least(target, px - cut), target.shape[0]):
            dx = target[j, 0] - px
            if dx > cut:
                break
            dy = target[j, 1] - py
            if dy > cut or dy < -cut:
                continue
            weight = target_weights[j] * math.exp(scale * (dx * dx + dy * dy))
            total += weight
            mean_x += weight * dx
            mean_y += weight * dy
            square += weight * (dx * dx + dy * dy)
        ratio = 1.0 - share + density * total
        value += source_weights[i] * math.log(ratio)
        part = density / ratio
        partner[i, 0] = source_weights[i] * part * total
        if total > 0.0:
            partner[i, 1] = px + mean_x / total
            partner[i, 2] = py + mean_y / total
        partner[i, 3] = source_weights[i] * part * square
        partner[i, 4], partner[i, 5] = px, py
    return value


@njit(cache=True, nogil=True)
def expectation_maximisation(
    source, source_weights, target, target_weights, area, min_sigma, max_sigma, state, max_steps,
    tolerance, information,
):  # fmt: skip
    """Iterate ``state`` (theta, x, y, sigma, share) in place; returns the log-likelihood ratio."""
    m = source.shape[0]
    partner = np.empty((m, 6))
    weight_sum = source_weights.sum()
    value = _expect(source, source_weights, target, target_weights, area, state, partner)
    for _ in range(max_steps):
        total, ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(m):
            w = partner[i, 0]
            if w > 0.0:
                total += w
                ax += w * source[i, 0]
                ay += w * source[i, 1]
                bx += w * partner[i, 1]
                by += w * partner[i, 2]
        if total < 1e-9:
            break
        ax, ay, bx, by = ax / total, ay / total, bx / total, by / total
        dot, cross = 0.0, 0.0
        for i in range(m):
            w = partner[i, 0]
            if w > 0.0:
                sx, sy = source[i, 0] - ax, source[i, 1] - ay
                qx, qy = partner[i, 1] - bx, partner[i, 2] - by
                dot += w * (sx * qx + sy * qy)
                cross += w * (sx * qy - sy * qx)
        theta = math.atan2(cross, dot) if dot != 0.0 or cross != 0.0 else state[0]
        cos, sin = math.cos(theta), math.sin(theta)
        x, y = bx - (cos * ax - sin * ay), by - (sin * ax + cos * ay)
        # The spread about the new pose: spread about the old one, corrected by the partners'
        # means.
        square = 0.0
        for i in range(m):
            w = partner[i, 0]
            if w > 0.0:
                ox, oy = partner[i, 1] - partner[i, 4], partner[i, 2] - partner[i, 5]
                nx = partner[i, 1] - (cos * source[i, 0] - sin * source[i, 1] + x)
                ny = partner[i, 2] - (sin * source[i, 0] + cos * source[i, 1] + y)
                square += partner[i, 3] - w * (ox * ox + oy * oy) + w * (nx * nx + ny * ny)
        sigma = math.sqrt(max(square, 0.0) / (2.0 * total))
        moved = abs(theta - state[0]) + (abs(x - state[1]) + abs(y - state[2])) / max_sigma
        moved += abs(math.log(max(sigma, min_sigma) / state[3]))
        state[0], state[1], state[2] = theta, x, y
        state[3] = min(max(sigma, min_sigma), max_sigma)
        state[4] = min(max(total / weight_sum, 1e-3), 0.98)
        value = _expect(source, source_weights, target, target_weights, area, state, partner)
        if moved < tolerance:
            break
    _observe(source, source_weights, target, target_weights, area, state, information)
    return value


@njit(cache=True, nogil=True)
def _observe(source, source_weights, target, target_weights, area, state, information):
    """Negative second derivatives of the likelihood in theta, x, y; partners are not certain."""
    theta, tx, ty, sigma, share = state[0], state[1], state[2], state[3], state[4]
    cos, sin = math.cos(theta), math.sin(theta)
    cut = 4.5 * sigma
    density = share * area / (target.shape[0] * 2.0 * math.pi * sigma * sigma)
    scale = 1.0 / (sigma * sigma)
    information[:, :] = 0.0
    for i in range(source.shape[0]):
        rx = cos * source[i, 0] - sin * source[i, 1]
        ry = sin * source[i, 0] + cos * source[i, 1]
        px, py = rx + tx, ry + ty
        total, mean_x, mean_y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(_first_at_least(target, px - cut), target.shape[0]):
            dx = target[j, 0] - px
            if dx > cut:
                break
            dy = target[j, 1] - py
            if dy > cut or dy < -cut:
                continue
            weight = target_weights[j] * math.exp(-0.5 * scale * (dx * dx + dy * dy))
            total += weight
            mean_x += weight * dx
            mean_y += weight * dy
            xx += weight * dx * dx
            xy += weight * dx * dy
            yy += weight * dy * dy
        part = density / (1.0 - share + density * total) * scale
        gx, gy = part * mean_x, part * mean_y
        w = source_weights[i]
        hxx = -w * (part * (xx * scale - total) - gx * gx)
        hyy = -w * (part * (yy * scale - total) - gy * gy)
        hxy = -w * (part * xy * scale - gx * gy)
        information[0, 0] += (
            ry * ry * hxx - 2.0 * rx * ry * hxy + rx * rx * hyy + w * (gx * rx + gy * ry)
        )
        information[0, 1] += -ry * hxx + rx * hxy
        information[0, 2] += -ry * hxy + rx * hyy
        information[1, 1] += hxx
        information[1, 2] += hxy
        information[2, 2] += hyy
    information[1, 0], information[2, 0] = information[0, 1], information[0, 2]
    information[2, 1] = information[1, 2]
