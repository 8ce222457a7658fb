"""Compile the doctor's kernels."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.doctor.turning.kernels import mean_nearness

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel on a few points."""
    mean_nearness(np.arange(3.0), np.zeros(3, np.int64), np.zeros(3), np.zeros(3), 0.5, 1.0, 1)
