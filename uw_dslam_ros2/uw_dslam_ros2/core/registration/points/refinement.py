"""A refined pose and what the points say about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Refinement"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined pose and what the points say about it."""

    parameters: FloatArray  # (3,): theta, x, y
    sigma_m: float  # estimated standard deviation of a pair along one axis
    num_pairs: float  # estimated number of source points with a partner
    log_likelihood: float  # ratio to "nothing belongs together", in nats
    information: FloatArray  # (3, 3), of theta, x, y

    def pose(self) -> SE2:
        """The same as a motion."""
        theta, x, y = self.parameters
        return SE2(float(x), float(y), float(theta))

    def covariance(self) -> FloatArray:
        """Inverse information (3, 3) of theta, x, y; infinite where it is singular."""
        if not self.information.any():
            return np.full((3, 3), math.inf)
        scale = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        normed = self.information / np.outer(scale, scale)
        if np.linalg.eigvalsh(normed)[0] < 1e-9:
            return np.full((3, 3), math.inf)
        # The pose took three of the pairs' degrees of freedom from the estimate of the noise.
        num_numbers = 2.0 * max(self.num_pairs, 3.0)
        inflation = num_numbers / (num_numbers - 3.0)
        covariance: FloatArray = inflation * np.linalg.inv(normed) / np.outer(scale, scale)
        return covariance
