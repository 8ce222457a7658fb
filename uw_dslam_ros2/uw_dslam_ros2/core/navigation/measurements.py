"""Measurement models of the navigation filter: innovation, Jacobian and noise at a state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.navigation.kernels import NUM_STATES
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["Clone", "Event", "Fix", "Model", "Velocity", "Yaw", "YawRate"]

FloatArray = NDArray[np.float64]
Model = tuple[FloatArray, FloatArray, FloatArray]
"""Innovation (m,), Jacobian (m, NUM_STATES), noise (m, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Yaw:
    """Yaw of base_link with a slow unknown offset."""

    yaw_rad: float
    sigma_rad: float

    def model(self, state: FloatArray) -> Model:
        """``z = yaw + offset``."""
        jac = np.zeros((1, NUM_STATES))
        jac[0, 2] = jac[0, 8] = 1.0
        innovation = np.array([wrap_angle(self.yaw_rad - float(state[2] + state[8]))])
        return innovation, jac, np.array([[self.sigma_rad**2]])


@dataclass(frozen=True, slots=True, eq=False)
class YawRate:
    """Yaw rate with a bias."""

    yaw_rate_rad_s: float
    sigma_rad_s: float

    def model(self, state: FloatArray) -> Model:
        """``z = rate + bias``."""
        jac = np.zeros((1, NUM_STATES))
        jac[0, 5] = jac[0, 6] = 1.0
        innovation = np.array([self.yaw_rate_rad_s - state[5] - state[6]])
        return innovation, jac, np.array([[self.sigma_rad_s**2]])


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """Velocity (2,) along the axes of the instrument mounted at `T_base_sensor`."""

    velocity_m_s: FloatArray
    noise: FloatArray
    T_base_sensor: SE2

    def model(self, state: FloatArray) -> Model:
        """``z = R_mount^T (u + rate x lever)``."""
        lever = np.array([-self.T_base_sensor.y, self.T_base_sensor.x])
        rotation = self.T_base_sensor.rotation().T
        jac = np.zeros((2, NUM_STATES))
        jac[:, 3:5] = rotation
        jac[:, 5] = rotation @ lever
        expected = rotation @ (state[3:5] + state[5] * lever)
        return self.velocity_m_s - expected, jac, self.noise


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Pose relative to the clone, as a scan match finds it.

    `information` (3, 3) may be singular.
    """

    T_clone_base: SE2
    information: FloatArray

    def model(self, state: FloatArray) -> Model:
        """``z = clone^-1 pose``, along the directions that the match knows."""
        expected, jac = relative_pose(state)
        delta = self.T_clone_base.as_array() - expected
        delta[2] = wrap_angle(float(delta[2]))
        values, vectors = np.linalg.eigh(self.information)
        known = values > 1e-9 * max(1.0, float(values[-1]))
        directions = vectors[:, known].T
        return directions @ delta, directions @ jac, np.diag(1.0 / values[known])


@dataclass(frozen=True, slots=True, eq=False)
class Clone:
    """Remember the pose of now, correlations included, for relative measurements to come."""


Event = Yaw | YawRate | Velocity | Fix | Clone


def relative_pose(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``clone^-1 pose`` as x, y, yaw (3,) and its Jacobian (3, NUM_STATES)."""
    cos, sin = math.cos(state[13]), math.sin(state[13])
    dx, dy = state[0] - state[11], state[1] - state[12]
    x, y = cos * dx + sin * dy, -sin * dx + cos * dy
    jac = np.zeros((3, NUM_STATES))
    jac[0, 0], jac[0, 1], jac[0, 11], jac[0, 12], jac[0, 13] = cos, sin, -cos, -sin, y
    jac[1, 0], jac[1, 1], jac[1, 11], jac[1, 12], jac[1, 13] = -sin, cos, sin, -cos, -x
    jac[2, 2], jac[2, 13] = 1.0, -1.0
    return np.array([x, y, wrap_angle(float(state[2] - state[13]))]), jac
