"""Compile the registration's kernels, with the argument types they are called with."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.grids.warm_up import warm_up as warm_up_grids
from uw_dslam_ros2.core.registration.points.register import register_point_sets

__all__ = ["warm_up"]


def warm_up() -> None:
    """Match a few points with every method, and two small maps."""
    points, others = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 8, 2))
    for method in ("likelihood", "gmrbnb"):
        register_point_sets(points, points + 1.0, RegistrationConfig(method=method, gap=0.2))
    register_point_sets(points, others)  # undecided: every kernel is asked
    warm_up_grids()
