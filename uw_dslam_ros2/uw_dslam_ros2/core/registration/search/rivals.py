"""Which other poses could be as good: neighbourhoods of optima with proven bounds.

The second phase of `branch_and_bound.search` sorts every box that could hold more than a share of
the best value into the neighbourhood of an optimum, a cube of half width `radius_m` around it.
What is left is bounded by `upper_elsewhere`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.search.problem import Problem
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.suppression import first_apart

__all__ = ["Neighborhoods"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Neighborhoods:
    """Optima that were met, best first, and what bounds the objective around each."""

    problem: Problem
    optima: FloatArray  # (F, 4): value and centred theta, x, y
    bounds: FloatArray  # (F,), largest bound of a box counted to that neighbourhood
    upper_undecided: float  # of all boxes that were excluded, or are still open
    upper_elsewhere: float  # no pose beyond all neighbourhoods exceeds it
    radius_m: float  # of a neighbourhood along x and y, and along yaw times the arm

    @classmethod
    def of(
        cls, problem: Problem, found: FloatArray, upper_undecided: float, upper_beside: float
    ) -> Neighborhoods:
        """From the kernels' list, rows value, theta, x, y, bound, the best value first."""
        bounds = np.maximum(found[:, 4], found[:, 0] + problem.margin)
        return cls(
            problem,
            found[:, :4],
            bounds,
            upper_undecided,
            max(upper_undecided, upper_beside),
            problem.radius,
        )

    def upper_bound(self, T_target_source: SE2) -> float:
        """Proven upper bound at a pose of the window, by the neighbourhoods that it lies in."""
        distance = self._distances(self.problem.pose_of(T_target_source))
        # A box that lies partly in a neighbourhood was split down to half widths of 0.2 reaches.
        is_inside = distance <= self.radius_m - 0.4 * self.problem.reach
        near = self.bounds[distance <= self.radius_m]
        upper = self.upper_undecided if is_inside.any() else self.upper_elsewhere
        return max(upper, float(near.max(initial=-np.inf)))

    def rivals(self, least: float) -> FloatArray:
        """Optima from a value on, apart from the best and each other.

        Returns rows (R, 5): value, upper bound of the neighbourhood, x, y, yaw.
        """
        rows = []
        for k in self.apart_from_better(2.0 * self.radius_m)[1:]:
            if self.optima[k, 0] < least:
                break
            touching = self._distances(self.optima[k, 1:]) <= 2.0 * self.radius_m
            upper = max(float(self.bounds[touching].max()), self.upper_undecided)
            T = self.problem.motion_of(*self.optima[k, 1:])
            rows.append([self.optima[k, 0], upper, T.x, T.y, T.yaw])
        return np.array(rows).reshape(-1, 5)

    def apart_from_better(self, distance_m: float) -> NDArray[np.int64]:
        """Indices of the optima further than that from every better one that was chosen."""
        num_finite = int(np.isfinite(self.optima[:, 0]).sum())  # best first, so they are the first
        chosen = first_apart(
            num_finite,
            lambda k: self._distances(self.optima[k, 1:])[:num_finite] <= distance_m,
        )
        return np.array(chosen, dtype=np.int64)

    def _distances(self, pose: FloatArray) -> FloatArray:
        """Greatest of the shifts along x and y and the turn times the arm, to every optimum."""
        apart = np.abs(self.optima[:, 1:] - pose)
        apart[:, 0] = self.problem.arm * np.abs(wrap_angle(self.optima[:, 1] - pose[0]))
        return np.asarray(apart.max(axis=1))
