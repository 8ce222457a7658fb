"""From two maps to the problems that are searched and refined, or to what a map lacks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uw_dslam_ros2.core.features.grid_filter import (
    FilteredCells,
    clean_masks,
    coarsen,
    split,
)
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap
from uw_dslam_ros2.core.registration.grids.problem import build_problem
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid

__all__ = [
    "FINE_SIGMA_CELLS",
    "Sides",
    "in_a_mirror",
    "make_levels",
    "on_cells_of",
    "prepare_maps",
]

Sides = tuple[WallMap, WallMap]
"""Source and target on cells of one size."""

FINE_SIGMA_CELLS = 2.0
"""Kernel of the walls on the finest level, in its cells."""
_FINE_POINTS = 1200
_LEAST_SIDE_CELLS = 4
# Cells of the scan within that distance, at least: with fewer the walls' kernels run together.
_SCANNED_PER_SPACING = 2.0
# Maps that are bent agree on larger cells, up to where everything free would be near a wall.
_NUM_SCALES = 4
_LEAST_SPACING = 4.0  # cells, between walls and the middle of the free space
# Where most of what is free is near a wall of large cells, only smaller ones tell where walls are.
_ENOUGH_SPACING = 8.0  # cells
_MOST_SCANNED, _MOST_FINEST = 4.0, 2.0  # times the cells asked for, of a map far larger


def prepare_maps(
    source: OccupancyMap,
    target: OccupancyMap,
    config: GridRegistrationConfig,
    names: tuple[str, str] = ("source", "target"),
) -> tuple[Pyramid, list[Sides]] | str:
    """Problems from coarse to fine, and both maps from fine to coarse; or what a map lacks.

    ``names`` are what the caller calls the two. The finest problem is on the cells of one pair of
    the maps.
    """
    resolution_m = _finest_resolution(source, target, config.finest_cells)
    sides = []
    for name, occupancy in zip(names, (source, target), strict=True):
        cells = clean_masks(occupancy)
        if (fault := _too_little(name, occupancy, cells, config.min_wall_cells)) is not None:
            return fault
        sides.append(WallMap(coarsen(cells, resolution_m)))
        del cells  # far larger than what is left of a large map
    finest = (sides[0], sides[1])
    return make_levels(*finest, config), _scales(finest)


def _scales(finest: Sides) -> list[Sides]:
    """Both maps on cells doubled each time, as long as walls stand apart from each other.

    And first on cells half as large as the finest, where walls stand close on those.
    """
    spacing = min(_wall_spacing(walls) for walls in finest)
    scales = [finest]
    while len(scales) < _NUM_SCALES and 2 ** len(scales) * _LEAST_SPACING <= spacing < math.inf:
        cells = [
            coarsen(walls.cells, walls.cells.resolution_m * 2.0 ** len(scales)) for walls in finest
        ]
        scales.append((WallMap(cells[0]), WallMap(cells[1])))
    if spacing < _ENOUGH_SPACING:
        source, target = (WallMap(split(walls.cells), is_split=True) for walls in finest)
        scales.insert(0, (source, target))
    return scales


def on_cells_of(scales: Sequence[Sides], resolution_m: float) -> Sides:
    """Both maps on cells of that size, one of those that there are."""
    return next(sides for sides in scales if sides[0].cells.resolution_m == resolution_m)


def in_a_mirror(walls: WallMap) -> WallMap:
    """A map with left and right exchanged."""
    cells = walls.cells
    wall, free, known, row, col = (
        np.ascontiguousarray(values[:, ::-1])
        for values in (cells.wall, cells.free, cells.known, cells.row, cells.col)
    )
    image = FilteredCells(cells.resolution_m, wall, free, known, row, wall.shape[1] - col)
    return WallMap(image, walls.is_split)


def _finest_resolution(source: OccupancyMap, target: OccupancyMap, num_cells: int) -> float:
    specs = (source.spec, target.spec)
    coarser = max(spec.resolution_m for spec in specs)
    sides = sorted(max(spec.shape) * spec.resolution_m / coarser for spec in specs)
    # A whole multiple, whose sums are quick.
    return coarser * _cell_size(sides, num_cells, _MOST_FINEST)


def _cell_size(sides: Sequence[float], num_cells: int, most: float) -> int:
    """How many cells make one, given the longer sides of the smaller and of the larger map.

    As many as leave the larger map ``num_cells``; but a small map in a large one needs smaller
    cells, or nothing is left of it: half of ``num_cells`` along itself, as long as the larger map
    has at most ``most`` times as many.
    """
    smaller, larger = sides
    size = max(min(larger, 2.0 * smaller), larger / most) / num_cells
    return max(1, math.ceil(size - 1e-9))


def make_levels(source: WallMap, target: WallMap, config: GridRegistrationConfig) -> Pyramid:
    """Problems whose cells are halved from those of the scan to the finest."""
    sides = sorted(max(walls.cells.shape) for walls in (source, target))
    num_cells = config.working_cells
    unit = max(1, math.ceil(sides[1] / num_cells))
    least = max(1, math.ceil(sides[1] / (_MOST_SCANNED * num_cells)))
    detail = min(_wall_spacing(walls) for walls in (source, target))
    stride = _cell_size(sides, num_cells, _MOST_SCANNED)
    # Without any free cell the spacing is infinite.
    strides = [max(min(stride, least), int(min(stride, detail / _SCANNED_PER_SPACING)))]
    while strides[-1] > 1:
        strides.append((strides[-1] + 1) // 2)
    levels = []
    for number, stride in enumerate(strides):
        levels.append(
            build_problem(
                source.cells,
                target.cells,
                stride=stride,
                sigma_cells=config.sigma_cells if stride > 1 else FINE_SIGMA_CELLS,
                free_penalty=config.free_penalty,
                max_points=config.max_points if number < 2 else _FINE_POINTS,
                distances=(source.distance, target.distance),
            )
        )
    return Pyramid(tuple(levels), unit / strides[0])


def _wall_spacing(walls: WallMap) -> float:
    """How far free cells are from a wall [cells], the median; infinite without any free cell."""
    distance = walls.distance[walls.cells.free > 0.5]
    return float(np.median(distance)) if len(distance) else math.inf


def _too_little(
    name: str, occupancy: OccupancyMap, cells: FilteredCells, min_wall_cells: int
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
