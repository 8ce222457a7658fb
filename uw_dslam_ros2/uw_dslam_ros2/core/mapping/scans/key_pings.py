"""Key pings: those whose echoes are matched with the last ones, to correct dead reckoning."""

from __future__ import annotations

import math

import numpy as np

from uw_dslam_ros2.core.mapping.config import WIDE_BEAM_RAD, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.scans.local_map import LocalMap, joined
from uw_dslam_ros2.core.mapping.scans.matcher import Prior
from uw_dslam_ros2.core.navigation import NavigationFilter
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections

__all__ = ["KeyPings"]

_MIN_OVERLAP = 0.3
"""Least share of a ping's echoes that must meet known ones for a match to be believed."""


class KeyPings:
    """Matches pings with the last stretch of the path, in the frame of the open submap."""

    def __init__(self, config: VehicleMapperConfig, navigation: NavigationFilter) -> None:
        self._config, self._navigation = config, navigation
        self._local_map = LocalMap(config.match)
        self._last: tuple[int, SE2] | None = None
        self.num_pings = 0
        """Of them; for a sonar that turns those that have something to be compared with."""
        self.num_matches = 0
        """Of those, how many were believed."""
        self.overlap_last = math.nan
        """Share of the last one's echoes that met known ones; NaN before the first match."""

    def rebase(self, T_new_previous: SE2) -> None:
        """Go on in the frame of a new submap."""
        self._local_map.rebase(T_new_previous)
        if self._last is not None:
            self._last = (self._last[0], T_new_previous @ self._last[1])

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a ping of now is to be one."""
        if self._config.estimator == "dead_reckoning":
            return False
        if self._last is None:
            return True
        config = self._config.match
        last_ns, last = self._last
        distance, turn = last.distance_to(self._navigation.relative_at(stamp_ns)[0])
        return (
            distance >= config.key_distance_m
            or turn >= config.key_turn_rad
            or (stamp_ns - last_ns) * 1e-9 >= config.key_interval_s
        )

    def match(self, detections: Detections, T_base_sonar: SE2) -> None:
        """Correct the pose of now by the echoes of this ping, then remember them."""
        stamp_ns = detections.stamp_ns
        points = T_base_sonar.apply(detections.points)
        T_submap_base, covariance = self._navigation.relative_at(stamp_ns)
        # A turn later the place may be another one: then there is nothing that should match.
        is_comparable = detections.beamwidth_rad < WIDE_BEAM_RAD or self._local_map.is_near(
            T_submap_base.apply(points)
        )
        self.num_pings += is_comparable
        # A pose that is exactly known cannot be corrected; a millimetre keeps the algebra regular.
        prior = Prior(T_submap_base, covariance + np.diag([1e-6, 1e-6, 1e-8]))
        match = self._local_map.match(points, detections.weight, prior)
        if match is not None:
            self.overlap_last = match.overlap
            if match.overlap >= _MIN_OVERLAP:
                self.num_matches += is_comparable
                self._navigation.add_fix(stamp_ns, match.T_target_source, match.information)
                T_submap_base, _ = self._navigation.relative_at(stamp_ns)
        if len(points):
            walls, weight = joined(
                points, detections.weight, detections.beamwidth_rad, self._config.match.sigma_m
            )
            self._local_map.add(T_submap_base.apply(walls), weight, T_submap_base)
        self._last = (stamp_ns, T_submap_base)
