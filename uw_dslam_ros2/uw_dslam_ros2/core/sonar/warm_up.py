"""Compile the front end's kernels."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.sonar.config import SonarConfig
from uw_dslam_ros2.core.sonar.detect import detect
from uw_dslam_ros2.core.sonar.types import SonarImage

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel on a tiny image of each usual type."""
    range_m, bearing_rad = np.arange(1.0, 9.0), np.linspace(-0.5, 0.5, 5)
    for dtype in (np.uint8, np.uint16, np.uint32, np.float32):
        intensity = np.ones((8, 5), dtype)
        intensity[4, :] = 100
        image = SonarImage(0, intensity, range_m, bearing_rad)
        for segmentation in ("fixed", "adaptive", "cfar_ca", "cfar_soca"):
            detect(
                image, SonarConfig(segmentation=segmentation, num_train_cells=2, num_guard_cells=1)
            )
