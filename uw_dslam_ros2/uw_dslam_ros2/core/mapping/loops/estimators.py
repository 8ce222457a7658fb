"""Who places the submaps: one interface, three answers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.loops.closures import find_loops
from uw_dslam_ros2.core.mapping.loops.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.loops.particles import ParticleFilter
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["SubmapEstimator", "make_estimator"]

FloatArray = NDArray[np.float64]


class SubmapEstimator(Protocol):
    """Places submaps in odom, of which the newest is still being built."""

    @property
    def poses(self) -> list[SE2]:
        """``T_odom_submap`` of every submap, as best known now."""

    @property
    def num_loops(self) -> int:
        """Loop closures found."""

    @property
    def num_loops_believed(self) -> int:
        """Loop closures that act on the poses."""

    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the newest submap's pose in odom, order x, y, yaw."""

    def add_first(self, T_odom_submap: SE2, covariance: FloatArray) -> None:
        """Begin with the first submap."""

    def add_next(self, T_previous_new: SE2, covariance: FloatArray) -> None:
        """Append a submap by odometry; covariance (3, 3) in the previous submap's frame."""

    def close_loops(self, sections: list[ClosedSection]) -> None:
        """The newest submap has closed: look where its echoes were seen before."""


class _Graph(SubmapGraph):
    """Dead reckoning, and with loops where the configuration says so."""

    def __init__(self, config: VehicleMapperConfig) -> None:
        super().__init__()
        self._config = config

    def close_loops(self, sections: list[ClosedSection]) -> None:
        """Look for loops of the newest submap, if that is asked for."""
        if self._config.estimator == "scan_matching" and self._config.loop.is_enabled:
            find_loops(self, sections, self._config)


def make_estimator(config: VehicleMapperConfig) -> SubmapEstimator:
    """The estimator that the configuration names."""
    return ParticleFilter(config) if config.estimator == "particle_filter" else _Graph(config)
