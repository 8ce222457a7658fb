"""Covariances of composed motions, order x, y, yaw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2

__all__ = ["composed_covariance", "rotated_covariance"]

FloatArray = NDArray[np.float64]


def rotated_covariance(covariance: FloatArray, yaw_rad: float) -> FloatArray:
    """Covariance (3, 3) in a frame that is turned back by `yaw_rad`."""
    rotation = np.eye(3)
    rotation[:2, :2] = SE2(yaw=yaw_rad).rotation()
    return rotation @ covariance @ rotation.T


def composed_covariance(
    T_a_b: SE2, covariance_b: FloatArray, T_b_c: SE2, covariance_c: FloatArray
) -> FloatArray:
    """Covariance (3, 3) of ``T_a_b @ T_b_c`` in a; of the first in a, of the second in b."""
    lever = T_a_b.rotation() @ (T_b_c.x, T_b_c.y)
    jac = np.eye(3)
    jac[0, 2], jac[1, 2] = -lever[1], lever[0]
    return jac @ covariance_b @ jac.T + rotated_covariance(covariance_c, T_a_b.yaw)
