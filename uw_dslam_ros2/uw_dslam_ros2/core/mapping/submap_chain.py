"""One run's submaps in order: the one that grows, those that are closed, and where each lies."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.loops.estimators import make_estimator
from uw_dslam_ros2.core.mapping.mapper_state import HeldSubmaps, MapperState
from uw_dslam_ros2.core.mapping.section import ClosedSection, OpenSection
from uw_dslam_ros2.core.mapping.vehicle_map import VehicleMap, path_of
from uw_dslam_ros2.core.pose_graph import chained_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["MapperWatch", "SubmapChain"]

FloatArray = NDArray[np.float64]
MapperWatch = Callable[[SubmapId, Detections, SE2, SE2 | None], None]
_REISSUE_M, _REISSUE_RAD = 0.02, 0.002
"""A submap that moved by more is given away again."""


class SubmapChain:
    """Opens, closes and places the submaps of a run.

    Parameters
    ----------
    config
        Of the mapper.
    track
        Whose run it is.
    watch
        Called with all that enters a submap's grid; see `core.mapping.section.Watch`.
    """

    def __init__(
        self, config: VehicleMapperConfig, track: Track, watch: MapperWatch | None = None
    ) -> None:
        self._config, self._track, self._watch = config, track, watch
        self._map = VehicleMap(config.occupancy)
        self.estimator = make_estimator(config)
        self.closed: list[ClosedSection] = []
        self.growing: OpenSection | None = None
        self._has_settled = False

    @property
    def is_empty(self) -> bool:
        """Whether there was no ping yet."""
        return not self.closed and self.growing is None

    @property
    def num_not_drawn(self) -> int:
        """Submaps with which the run's map would have been too large, when it was last drawn."""
        return self._map.num_left_out

    # --- one after the other ---------------------------------------------------------------------

    def begin(self, T_odom_submap: SE2, covariance: FloatArray) -> None:
        """Open the first submap; covariance (3, 3) in odom."""
        self.estimator.add_first(T_odom_submap, covariance)
        self._open(covariance)

    def go_on(self, T_previous_new: SE2, covariance: FloatArray) -> None:
        """Open the next submap; covariance (3, 3) in the previous submap's frame."""
        self.estimator.add_next(T_previous_new, covariance)
        self._open(covariance)

    def resume(self, state: MapperState, held: HeldSubmaps, drift: FloatArray) -> None:
        """Hold what another has held; `drift` (3, 3) is that of the open submap by now.

        What its loops said stays in the poses; the graph knows the odometry that follows from
        them.
        """
        poses = [SE2.from_array(pose) for pose in state.T_odom_submap]
        steps = [submap.covariance for submap, _ in held.closed[: state.sequence]]
        steps.append(state.covariance)
        self.estimator.add_first(poses[0], steps[0])
        for before, after, covariance in zip(poses, poses[1:], steps[1:], strict=False):
            self.estimator.add_next(before.inverse() @ after, covariance)
        self.closed = [
            ClosedSection.of(submap, weight, step)
            for (submap, weight), step in zip(held.closed, [*steps[1:], drift], strict=False)
        ]
        if len(self.closed) == state.sequence:
            self._open(state.covariance)
            assert self.growing is not None
            self.growing.resume(state.section, held.drawn)

    def close(self, drift: FloatArray) -> list[Submap]:
        """Close the one that grows, look for loops, and say which are new or have moved.

        `drift` (3, 3) is the covariance of its last pose relative to its first.
        """
        assert self.growing is not None
        section = self.growing.close(self.estimator.poses[-1], drift)
        self.closed.append(section)
        self.growing = None
        self.estimator.close_loops(self.closed)
        return self._issue(new=section)

    def issued(self, sequence: int) -> Submap | None:
        """A submap as it was given away last; None if there is none of this number."""
        for section in self.closed:
            if section.sequence == sequence:
                return self._submap_of(section)
        return None

    def submaps(self) -> list[Submap]:
        """All closed ones, as they were given away last."""
        return [self._submap_of(section) for section in self.closed]

    def replace(self, drawn_anew: Sequence[Submap]) -> None:
        """Take all closed submaps, in their order, as somebody drew and placed them anew.

        None may follow.
        """
        for section, submap in zip(self.closed, drawn_anew, strict=True):
            section.replace(submap)
        self._has_settled = True

    # --- what they make together -----------------------------------------------------------------

    def T_odom_base(self, T_submap_base: SE2) -> SE2:  # noqa: N802 (a motion)
        """Where the vehicle is in odom, which is there in the submap that grows.

        Where none grows, it is where the last one ended.
        """
        if self.growing is None:
            T_submap_base = SE2.from_array(self.closed[-1].trajectory[-1])
        return self._poses()[-1] @ T_submap_base

    def covariance(self, T_submap_base: SE2, own: FloatArray) -> FloatArray:
        """Covariance (3, 3) of that pose in odom; `own` (3, 3) is that in the submap."""
        if self.growing is None:
            T_submap_base, own = SE2(), np.zeros((3, 3))
        before = self.estimator.covariance()
        return chained_covariance(self._poses()[-1], before, T_submap_base, own)

    def trajectory(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Stamps (K,) and poses (K, 3) of base_link in odom at every ping, as best known now."""
        return path_of(self.closed, self.growing, self._poses())

    def occupancy(self) -> OccupancyMap:
        """All submaps, the one that grows included, in odom: as they were last issued."""
        return self._map.draw(self.closed, self.growing, self._poses()[-1])

    # --- inside ----------------------------------------------------------------------------------

    def _poses(self) -> list[SE2]:
        """``T_odom_submap`` of each: the graph's, until somebody places them anew."""
        if self._has_settled:
            return [section.T_odom_issued for section in self.closed]
        return self.estimator.poses

    def _open(self, covariance: FloatArray) -> None:
        index = len(self.closed)
        watch = None
        if self._watch is not None:
            watch = functools.partial(self._watch, SubmapId(*self._track, index))
        self.growing = OpenSection(self._config, index, covariance, watch)

    def _issue(self, new: ClosedSection) -> list[Submap]:
        issued = []
        for section, T_odom_submap in zip(self.closed, self.estimator.poses, strict=False):
            distance, turn = section.T_odom_issued.distance_to(T_odom_submap)
            has_moved = distance > _REISSUE_M or turn > _REISSUE_RAD
            if section is not new:
                if not has_moved:
                    continue
                section.revision += 1
            section.T_odom_issued = T_odom_submap
            issued.append(self._submap_of(section))
        return issued

    def _submap_of(self, section: ClosedSection) -> Submap:
        log_odds_max = self._config.occupancy.log_odds_max
        return section.to_submap(*self._track, section.T_odom_issued, log_odds_max)
