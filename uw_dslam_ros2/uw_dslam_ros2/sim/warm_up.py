"""Compile the simulator's kernels."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig, SonarSimulator
from uw_dslam_ros2.sim.waters.raster import grid_over, seen_map
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel once on something small."""
    builder = WorldBuilder()
    builder.add(Surface("wall", 0.0, 0.0), [[5.0, -5.0], [5.0, 5.0]])
    world = builder.build("wall", 0, (0.0, 0.0), 8.0)
    sonar = SonarSimulator(world, SonarConfig(num_beams=16, num_ranges=32, max_range_m=10.0))
    sonar.ping(0, SE2(), 3.0, np.random.default_rng(0))
    seen_map(world, grid_over(world, 1.0), [[0.0, 0.0, 0.0]], 2.0, 10.0)
