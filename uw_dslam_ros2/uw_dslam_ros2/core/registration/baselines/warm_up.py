"""Compile the baselines' kernels, with the argument types they are called with."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.registration.baselines.suite import point_baselines

__all__ = ["warm_up"]


def warm_up() -> None:
    """Match a few points with every baseline for points."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2))
    for matcher in point_baselines().values():
        matcher(points, points)
