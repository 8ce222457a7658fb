"""From two maps to the problems that are searched and refined, or to what a map lacks."""

from __future__ import annotations

import math

from uw_dslam_ros2.core.features.grid_filter import CellEvidence, clean_cells, coarsen
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.grids.agreement import WallMap
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, build_problem

__all__ = ["FINE_SIGMA_CELLS", "prepare_maps"]

FINE_SIGMA_CELLS = 2.0
"""Kernel of the walls on the finest level, in its cells."""
_FINE_POINTS = 1200
_LEAST_SIDE_CELLS = 4


def prepare_maps(
    source: OccupancyMap, target: OccupancyMap, config: GridRegistrationConfig
) -> tuple[list[GridProblem], tuple[WallMap, WallMap]] | str:
    """Problems from coarse to fine, and both maps; or what a map lacks, as a sentence."""
    resolution_m = _finest_resolution(source, target, config.finest_cells)
    sides = []
    for name, occupancy in (("source", source), ("target", target)):
        cells = clean_cells(occupancy)
        if (fault := _too_little(name, occupancy, cells, config.min_wall_cells)) is not None:
            return fault
        sides.append(coarsen(cells, resolution_m))
    walls = (WallMap(sides[0]), WallMap(sides[1]))
    return _levels(*walls, config), walls


def _finest_resolution(source: OccupancyMap, target: OccupancyMap, num_cells: int) -> float:
    specs = (source.spec, target.spec)
    longest_m = max(max(spec.shape) * spec.resolution_m for spec in specs)
    coarser = max(spec.resolution_m for spec in specs)
    # A whole multiple, whose sums are quick.
    return coarser * math.ceil(longest_m / coarser / num_cells - 1e-9)


def _levels(source: WallMap, target: WallMap, config: GridRegistrationConfig) -> list[GridProblem]:
    """Problems from the searched lattice to the finest one."""
    longest = max(*source.cells.shape, *target.cells.shape)
    stride = max(1, math.ceil(longest / config.working_cells))
    strides = [stride]
    while strides[-1] > 1:
        strides.append(max(1, strides[-1] // 2))
    levels = []
    for stride in strides:
        is_search = stride == strides[0]
        levels.append(
            build_problem(
                source.cells,
                target.cells,
                stride=stride,
                sigma_cells=config.sigma_cells if stride > 1 else FINE_SIGMA_CELLS,
                free_penalty=config.free_penalty,
                max_points=config.max_points if is_search else _FINE_POINTS,
                distances=(source.distance, target.distance),
            )
        )
    return levels


def _too_little(
    name: str, occupancy: OccupancyMap, cells: CellEvidence, min_wall_cells: int
) -> str | None:
    """What a map lacks for matching, as a sentence, or None."""
    rows, cols = occupancy.spec.shape
    if min(rows, cols) < _LEAST_SIDE_CELLS:
        return f"the {name} map has {rows} x {cols} cells, expected at least {_LEAST_SIDE_CELLS}"
    if not occupancy.known.any():
        return f"the {name} map is unknown everywhere"
    num_walls = int((cells.wall > 0.25).sum())
    share = float((occupancy.values >= 60).mean())
    if share > 0.6:
        return f"the {name} map is occupied in {share:.0%} of its cells, so it shows no surface"
    if num_walls < min_wall_cells:
        return (
            f"the {name} map has {num_walls} wall cells after filtering, "
            f"expected at least {min_wall_cells}"
        )
    return None
