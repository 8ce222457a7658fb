"""The submap that is being built, and what stays of closed ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import SubmapConfig, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import CompressedGrid
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.mapping.mapper_state import SectionState
from uw_dslam_ros2.core.mapping.scans.local_map import joined
from uw_dslam_ros2.core.mapping.scans.matcher import thin
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.turning import PlacedSweep
from uw_dslam_ros2.core.sonar.types import Detections
from uw_dslam_ros2.core.submap import Submap

__all__ = ["ClosedSection", "OpenSection"]

FloatArray = NDArray[np.float64]
Watch = Callable[[Detections, SE2, SE2 | None], None]
"""Called with all that enters a grid, its ``T_submap_sonar``, and where the sonar was by dead
reckoning alone, in a frame that drifts; None where that is not known."""

_BLIND_S, _LEAST_BLIND_S = 60.0, 8.0
"""All of a vehicle that has had no velocity for so long is uncertain at once, and submaps of a few
pings join nothing: they last so long at least. Where a velocity is lost for a while, small ones
hang together through what is known, and bend where a long one could not."""
_MIN_MOTION_M, _MIN_TURN_RAD, _MIN_INTERVAL_S = 0.1, 0.02, 1.0
"""A ping enters the grid after this path length, turn or time, whichever comes first: pings of
one place repeat one another's errors, and a vehicle at rest would be ever more sure of them.
"""


@dataclass(slots=True, eq=False)
class ClosedSection:
    """A closed submap: rigid from now on; only its pose and revision change."""

    sequence: int
    stamp_ns: int
    grid: CompressedGrid
    points: FloatArray
    weight: FloatArray
    trajectory: FloatArray
    stamps_ns: NDArray[np.int64]
    covariance: FloatArray
    drift: FloatArray
    T_odom_issued: SE2
    revision: int = 0

    @property
    def center(self) -> FloatArray:
        """Mean of its points (2,) in its own frame; the zero where there are none."""
        return self.points.mean(axis=0) if len(self.points) else np.zeros(2)

    @property
    def radius_m(self) -> float:
        """Distance from the centre within which nine of ten points lie."""
        if len(self.points) == 0:
            return 0.0
        return float(np.quantile(np.linalg.norm(self.points - self.center, axis=1), 0.9))

    @classmethod
    def of(cls, submap: Submap, weight: FloatArray, drift: FloatArray) -> ClosedSection:
        """What `to_submap` gave, to the percent; with what it does not give."""
        return cls(
            submap.sequence,
            submap.stamp_ns,
            CompressedGrid.of(submap.grid),
            submap.points,
            weight,
            submap.trajectory,
            submap.trajectory_stamp_ns,
            submap.covariance,
            drift,
            submap.T_odom_submap,
            submap.revision,
        )

    def replace(self, submap: Submap) -> None:
        """Be a later revision of what `to_submap` gave; points for matching stay as they are."""
        self.grid = CompressedGrid.of(submap.grid)
        self.trajectory, self.T_odom_issued = submap.trajectory, submap.T_odom_submap
        self.revision = submap.revision

    def to_submap(
        self, vehicle_id: str, run_id: int, T_odom_submap: SE2, log_odds_max: float
    ) -> Submap:
        """What the vehicle gives away."""
        return Submap(
            vehicle_id,
            self.sequence,
            self.revision,
            True,
            self.stamp_ns,
            T_odom_submap,
            self.covariance,
            self.grid.decompressed().to_occupancy(log_odds_max),
            self.points,
            self.trajectory,
            self.stamps_ns,
            run_id,
        )


class OpenSection:
    """Pings of one submap in its own frame, base_link's pose at its start."""

    def __init__(
        self,
        config: VehicleMapperConfig,
        sequence: int,
        covariance: FloatArray,
        watch: Watch | None = None,
    ) -> None:
        self._config = config
        self.sequence = sequence
        self._covariance = covariance
        self.grid = GrowingGrid(config.occupancy)
        self._points: list[FloatArray] = []
        self._weight: list[FloatArray] = []
        self._trajectory: list[tuple[float, float, float]] = []
        self._stamps_ns: list[int] = []
        self._length_m = 0.0
        self._last_mapped: tuple[int, SE2] | None = None
        self.num_pings = 0
        self._watch = watch

    def resume(self, held: SectionState, drawn: Iterable[tuple[Detections, SE2]]) -> None:
        """Hold what another has held; ``drawn`` is what entered its grid, and from where."""
        self._points, self._weight = [held.points], [held.weight]
        self._trajectory = [(x, y, yaw) for x, y, yaw in held.trajectory.tolist()]
        self._stamps_ns = held.stamps_ns.tolist()
        self._length_m = float(np.hypot(*np.diff(held.trajectory[:, :2], axis=0).T).sum())
        self.num_pings = held.num_pings
        for detections, T_submap_sonar in drawn:
            self.grid.add(detections, T_submap_sonar)

    def state(self, num_poses: int = 0, num_echoes: int = 0) -> SectionState:
        """What has come after so many poses, and pings with echoes; by default all."""
        return SectionState(
            self.num_pings,
            self.grid.num_pings,
            np.array(self._trajectory[num_poses:]).reshape(-1, 3),
            np.array(self._stamps_ns[num_poses:], dtype=np.int64),
            np.vstack([np.empty((0, 2)), *self._points[num_echoes:]]),
            np.concatenate([np.empty(0), *self._weight[num_echoes:]]),
        )

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of its pose, relative to the submap before."""
        return self._covariance

    @property
    def num_echoes(self) -> int:
        """Pings whose echoes are kept for matching."""
        return len(self._points)

    @property
    def poses(self) -> FloatArray:
        """``T_submap_base`` of each ping (K, 3)."""
        return np.array(self._trajectory).reshape(-1, 3)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Time of each ping (K,)."""
        return np.array(self._stamps_ns, dtype=np.int64)

    def add(
        self,
        detections: Detections,
        T_submap_base: SE2,
        T_base_sonar: SE2,
        T_dead_base: SE2 | None,
    ) -> None:
        """Add one ping; it enters the grid only some distance, turn or time after the last.

        ``T_dead_base`` is where the vehicle is by dead reckoning alone, where that is known.
        """
        stamp_ns = detections.stamp_ns
        self._go_on(stamp_ns, T_submap_base)
        self.num_pings += 1
        if self._is_due(stamp_ns, T_submap_base):
            self._last_mapped = (stamp_ns, T_submap_base)
            self._draw(detections, T_submap_base, T_dead_base, T_base_sonar)
            self._keep(detections, T_submap_base @ T_base_sonar, detections.is_turn)

    def add_sweep(
        self, sweep: PlacedSweep, T_submap_reference: SE2, T_dead_reference: SE2 | None
    ) -> None:
        """Add a sweep of a sonar that turns: all its beams, each from its own place."""
        for stamp_ns, pose in zip(sweep.stamps_ns, sweep.path, strict=True):
            self._go_on(int(stamp_ns), T_submap_reference @ SE2.from_array(pose))
        self.num_pings += 1
        for part in sweep.slices:
            self._draw(
                part.detections, T_submap_reference, T_dead_reference, part.T_reference_sonar
            )
        self._keep(sweep.detections, T_submap_reference, is_turn=True)

    def _go_on(self, stamp_ns: int, T_submap_base: SE2) -> None:
        if self._trajectory:
            x, y, _ = self._trajectory[-1]
            self._length_m += math.hypot(T_submap_base.x - x, T_submap_base.y - y)
        self._trajectory.append((T_submap_base.x, T_submap_base.y, T_submap_base.yaw))
        self._stamps_ns.append(stamp_ns)

    def _draw(
        self,
        detections: Detections,
        T_submap_frame: SE2,
        T_dead_frame: SE2 | None,
        T_frame_sonar: SE2,
    ) -> None:
        T_submap_sonar = T_submap_frame @ T_frame_sonar
        self.grid.add(detections, T_submap_sonar)
        if self._watch is not None:
            T_dead_sonar = None if T_dead_frame is None else T_dead_frame @ T_frame_sonar
            self._watch(detections, T_submap_sonar, T_dead_sonar)

    def _keep(self, detections: Detections, T_submap_sonar: SE2, is_turn: bool) -> None:
        """Keep the echoes, and of a turn the walls between its wide beams, for matching."""
        if len(detections.points):
            points, weight = detections.points, detections.weight
            if is_turn:
                sigma_m = self._config.match.sigma_m
                points, weight = joined(points, weight, detections.beamwidth_rad, sigma_m)
            self._points.append(T_submap_sonar.apply(points))
            self._weight.append(weight)

    def should_close(self, stamp_ns: int, sigma_m: float, silence_s: float) -> bool:
        """Whether it has become long, old or uncertain enough, `silence_s` after a velocity."""
        config: SubmapConfig = self._config.submap
        if self.num_pings < config.min_pings:
            return False
        age_s = (stamp_ns - self._stamps_ns[0]) * 1e-9
        is_blind = silence_s > _BLIND_S
        return (
            self._length_m >= config.max_length_m
            or age_s >= config.max_duration_s
            or (sigma_m >= config.max_sigma_m and age_s >= (_LEAST_BLIND_S if is_blind else 0.0))
        )

    def close(self, T_odom_submap: SE2, drift: FloatArray) -> ClosedSection:
        """Freeze it; `drift` (3, 3) is the covariance of its last pose relative to its first."""
        points = np.vstack(self._points) if self._points else np.empty((0, 2))
        weight = np.concatenate(self._weight) if self._weight else np.empty(0)
        points, weight = thin(points, weight, self._config.match.sigma_m)
        return ClosedSection(
            self.sequence,
            self._stamps_ns[-1],
            self.grid.trimmed().compressed(),
            points,
            weight,
            self.poses,
            self.stamps_ns,
            self._covariance,
            drift,
            T_odom_submap,
        )

    def _is_due(self, stamp_ns: int, T_submap_base: SE2) -> bool:
        if self._last_mapped is None:
            return True
        last_ns, last = self._last_mapped
        distance, turn = last.distance_to(T_submap_base)
        return (
            distance >= _MIN_MOTION_M
            or turn >= _MIN_TURN_RAD
            or (stamp_ns - last_ns) * 1e-9 >= _MIN_INTERVAL_S
        )
