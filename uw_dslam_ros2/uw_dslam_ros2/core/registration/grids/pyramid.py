"""Problems of one match from coarse to fine: what is scanned, what is proven, what is answered."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.problem import GridProblem

__all__ = ["Pyramid", "carried"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Problems of the same two maps, each on cells at most as large as those before.

    All poses of the first are looked at. The second one decides which of them go on, and the proof
    is of it: there a thin wall still stands out from the free space beside it. What the verdict
    judges by is counted in cells that do not depend on how fine the search is.


    ``unit_cells`` is the side, in cells of the first, of the cells that poses are counted in.
    """

    problems: tuple[GridProblem, ...]
    unit_cells: float = 1.0

    @property
    def scanned(self) -> GridProblem:
        """The coarsest."""
        return self.problems[0]

    @property
    def searched(self) -> GridProblem:
        """The one whose optimum is proven."""
        return self.problems[min(1, len(self.problems) - 1)]

    @property
    def finest(self) -> GridProblem:
        """The one whose optimum is the answer."""
        return self.problems[-1]

    def steps_to_finest(self) -> list[tuple[GridProblem, GridProblem]]:
        """Pairs of neighbouring problems from the searched to the finest one."""
        return list(itertools.pairwise(self.problems[min(1, len(self.problems) - 1) :]))


def carried(coarse: GridProblem, fine: GridProblem, poses: FloatArray) -> FloatArray:
    """Poses (K, 3) of one problem as those of another one of the same maps."""
    if coarse is fine or len(poses) == 0:
        return poses
    return np.array([fine.pose_of(coarse.motion_of(pose)) for pose in poses])
