"""Compiled steps of the navigation filter.

State (14): x, y, yaw in odom; ux, uy body velocity as the sensor sees it; yaw rate; gyro bias;
velocity scale error; heading offset; current cx, cy in odom; clone of an earlier pose ax, ay,
ayaw. The velocity over ground is (1 + scale) u + current. Scale and current act on the motion and
not on the measurement: so only positions can teach them, and no change of speed is mistaken for
either.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["NUM_STATES", "gated_update", "predict"]

NUM_STATES = 14


@njit(cache=True, nogil=True)
def predict(state, covariance, dt_s, noise):  # type: ignore[no-untyped-def]
    """Motion over `dt_s`; returns new arrays.

    `noise` (7,): walks of velocity, turn, bias; sigma and time of heading offset, of current.

    Constant velocity and constant turn; offset and current are first-order Gauss-Markov. Returns
    new arrays.
    """
    x = state.copy()
    heading = state[2] + 0.5 * state[5] * dt_s
    cos, sin = np.cos(heading), np.sin(heading)
    scale = 1.0 + state[7]
    vx, vy = scale * state[3], scale * state[4]
    x[0] += (cos * vx - sin * vy + state[9]) * dt_s
    x[1] += (sin * vx + cos * vy + state[10]) * dt_s
    x[2] += state[5] * dt_s
    keep_offset = np.exp(-dt_s / noise[4])
    keep_current = np.exp(-dt_s / noise[6])
    x[8] *= keep_offset
    x[9] *= keep_current
    x[10] *= keep_current
    jac = np.eye(NUM_STATES)
    along, across = (-sin * vx - cos * vy) * dt_s, (cos * vx - sin * vy) * dt_s
    for axis, turned, ahead, left in ((0, along, cos, -sin), (1, across, sin, cos)):
        jac[axis, 2] = turned
        jac[axis, 3], jac[axis, 4] = scale * ahead * dt_s, scale * left * dt_s
        jac[axis, 5] = 0.5 * turned * dt_s
        jac[axis, 7] = (ahead * state[3] + left * state[4]) * dt_s
        jac[axis, 9 + axis] = dt_s
    jac[2, 5] = dt_s
    jac[8, 8] = keep_offset
    jac[9, 9] = keep_current
    jac[10, 10] = keep_current
    cov = jac @ covariance @ jac.T
    # White acceleration: position and velocity noise belong together.
    q_v, q_r = noise[0] * noise[0] * dt_s, noise[1] * noise[1] * dt_s
    for axis in range(2):
        cov[axis, axis] += q_v * dt_s * dt_s / 3.0
        cov[3 + axis, 3 + axis] += q_v
    half = 0.5 * q_v * dt_s
    cov[0, 3] += half * cos
    cov[3, 0] += half * cos
    cov[0, 4] -= half * sin
    cov[4, 0] -= half * sin
    cov[1, 3] += half * sin
    cov[3, 1] += half * sin
    cov[1, 4] += half * cos
    cov[4, 1] += half * cos
    cov[2, 2] += q_r * dt_s * dt_s / 3.0
    cov[2, 5] += 0.5 * q_r * dt_s
    cov[5, 2] += 0.5 * q_r * dt_s
    cov[5, 5] += q_r
    cov[6, 6] += noise[2] * noise[2] * dt_s
    cov[8, 8] += noise[3] * noise[3] * (1.0 - keep_offset * keep_offset)
    cov[9, 9] += noise[5] * noise[5] * (1.0 - keep_current * keep_current)
    cov[10, 10] += noise[5] * noise[5] * (1.0 - keep_current * keep_current)
    return x, cov


@njit(cache=True, nogil=True)
def _solved(matrix, right):  # type: ignore[no-untyped-def]
    """Solution (k, n) of a small symmetric positive definite system, by Cholesky's method.

    numba's `np.linalg.solve` does the same and takes ten seconds to compile.
    """
    size = len(matrix)
    lower, found = np.zeros((size, size)), right.copy()
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = rest / lower[j, j]
            elif rest > 0.0:
                lower[i, i] = np.sqrt(rest)
            else:
                raise ValueError("a measurement's covariance is not positive definite")
    for column in range(found.shape[1]):
        for i in range(size):
            for k in range(i):
                found[i, column] -= lower[i, k] * found[k, column]
            found[i, column] /= lower[i, i]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                found[i, column] -= lower[k, i] * found[k, column]
            found[i, column] /= lower[i, i]
    return found


@njit(cache=True, nogil=True)
def gated_update(state, covariance, innovation, jac, noise, gate):  # type: ignore[no-untyped-def]
    """Kalman update (Joseph form) unless the squared Mahalanobis distance exceeds `gate`.

    A negative gate is none.

    Returns the new state, covariance and the squared distance; the old ones where the gate
    refused.
    """
    cross = covariance @ jac.T
    spread = jac @ cross + noise
    distance = np.sum(innovation * _solved(spread, innovation.reshape(-1, 1)).ravel())
    if 0.0 <= gate < distance:
        return state, covariance, distance
    gain = _solved(spread, np.ascontiguousarray(cross.T)).T
    shrink = np.eye(NUM_STATES) - gain @ jac
    updated = shrink @ covariance @ shrink.T + gain @ noise @ gain.T
    return state + gain @ innovation, 0.5 * (updated + updated.T), distance
