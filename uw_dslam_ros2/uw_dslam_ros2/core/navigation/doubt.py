"""Whom the navigation filter believes where it knows little, or has been wrong."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.navigation.kernels import NUM_STATES
from uw_dslam_ros2.core.navigation.measurements import Velocity

__all__ = ["are_alike", "doubted"]

FloatArray = NDArray[np.float64]

_SOON_S = 2.0
"""However long apart, two velocities agree only if they could have followed so soon."""


def are_alike(
    said: tuple[int, FloatArray] | None,
    stamp_ns: int,
    event: Velocity,
    walk_m_s: float,
    gate: float,
) -> bool:
    """Whether a vehicle could have come to a velocity from the one measured before.

    Parameters
    ----------
    said : when that was measured [ns], and what, (2,) along base_link's axes [m/s].
    walk_m_s : how much a velocity may change within a second [m/s].
    gate : largest squared deviation, in sigmas.
    """
    if said is None:
        return False
    said_ns, said_m_s = said
    rotation = event.T_base_sensor.rotation()
    walk_s = min((stamp_ns - said_ns) * 1e-9, _SOON_S)
    spread = 2.0 * rotation @ event.noise @ rotation.T + np.eye(2) * walk_m_s**2 * walk_s
    change = rotation @ event.velocity_m_s - said_m_s
    return bool(change @ np.linalg.solve(spread, change) <= gate)


def doubted(
    state: FloatArray,
    covariance: FloatArray,
    jac: FloatArray,
    innovation: FloatArray,
    for_s: float,
) -> FloatArray:
    """Covariance of a filter whose velocity has been wrong by an innovation (2,) for some time."""
    wrong = jac[:, 3:5].T @ innovation
    cos, sin = math.cos(state[2]), math.sin(state[2])
    way = for_s * np.array([cos * wrong[0] - sin * wrong[1], sin * wrong[0] + cos * wrong[1]])
    error = np.zeros(NUM_STATES)
    error[:2], error[3:5] = way, wrong
    widened: FloatArray = covariance + np.outer(error, error)
    return widened
