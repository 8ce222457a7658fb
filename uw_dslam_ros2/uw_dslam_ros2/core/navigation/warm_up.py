"""Compile the filter's kernels."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.navigation.filter import NavigationFilter
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel with every measurement."""
    navigation = NavigationFilter()
    navigation.add_yaw(0, 0.1)
    navigation.add_yaw_rate(10_000_000, 0.0)
    navigation.add_velocity(20_000_000, (1.0, 0.0))
    navigation.clone(20_000_000)
    navigation.add_fix(30_000_000, SE2(0.01, 0.0, 0.0), np.eye(3))
