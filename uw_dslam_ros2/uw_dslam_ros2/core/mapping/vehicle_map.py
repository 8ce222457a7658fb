"""What a vehicle's submaps make together: one map, and one path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import MAX_MAP_SIDE, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.section import ClosedSection, OpenSection
from uw_dslam_ros2.core.mosaic import Mosaic
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["VehicleMap", "path_of"]

FloatArray = NDArray[np.float64]


class VehicleMap:
    """The sum of a vehicle's submaps; asked again, only what is new or has moved is drawn."""

    def __init__(self, config: OccupancyConfig) -> None:
        self._log_odds_max = config.log_odds_max
        self._mosaic = Mosaic(GridSpec(config.resolution_m, 1, 1))
        self._left_out: dict[int, tuple[int, SE2]] = {}

    @property
    def num_left_out(self) -> int:
        """Submaps with which the map would have been too large, when it was last drawn."""
        return len(self._left_out)

    def draw(
        self, closed: Sequence[ClosedSection], growing: OpenSection | None, T_odom_growing: SE2
    ) -> OccupancyMap:
        """All submaps in odom; closed ones lie where they were last issued.

        Those that would make it larger than maps are (`MAX_MAP_SIDE`) are left out.
        """
        mosaic, newest = self._mosaic, len(closed)
        for index, section in enumerate(closed):
            version = section.revision, section.T_odom_issued
            if version not in (mosaic.version_of(index), self._left_out.get(index)):
                mosaic.put(index, version, section.grid, section.T_odom_issued)
                if self._is_too_large():
                    mosaic.remove(index)
                    self._left_out[index] = version
                else:
                    self._left_out.pop(index, None)
        if growing is not None:
            mosaic.put(newest, None, growing.grid.trimmed(), T_odom_growing)
            if self._is_too_large():
                mosaic.remove(newest)
        occupancy = mosaic.occupancy(self._log_odds_max)
        mosaic.remove(newest)
        return occupancy or OccupancyMap(mosaic.lattice, np.full((1, 1), UNKNOWN, np.int8))

    def _is_too_large(self) -> bool:
        window = self._mosaic.window()
        return window is not None and max(window.shape) > MAX_MAP_SIDE


def path_of(
    closed: Sequence[ClosedSection], growing: OpenSection | None, T_odom_submap: Sequence[SE2]
) -> tuple[NDArray[np.int64], FloatArray]:
    """Stamps (K,) and poses (K, 3) in odom of all pings, submaps lying where they are said to."""
    parts = [(section.stamps_ns, section.trajectory) for section in closed]
    if growing is not None:
        parts.append((growing.stamps_ns, growing.poses))
    stamps = [np.empty(0, np.int64)]
    poses = [np.empty((0, 3))]
    for motion, (part_stamps, part) in zip(T_odom_submap, parts, strict=False):
        moved = np.column_stack([motion.apply(part[:, :2]), part[:, 2] + motion.yaw])
        moved[:, 2] = np.mod(moved[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        stamps.append(part_stamps)
        poses.append(moved)
    return np.concatenate(stamps), np.vstack(poses)
