"""Survey routes: loops along the walls and parallel legs, clear of everything, smooth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from skimage.graph import route_through_array

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.sim.waters.raster import grid_over, wall_mask
from uw_dslam_ros2.sim.waters.world import World

__all__ = ["SurveyArea", "plan_survey", "split_areas"]

FloatArray = NDArray[np.float64]

_CELL_M = 0.5
_STEP_M = 0.25
_SMOOTHING_M = 1.0
_NUM_SMOOTHINGS = 16  # together as one of 4 m


@dataclass(frozen=True, slots=True)
class SurveyArea:
    """A vehicle's share of the place: a rectangle [m]."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


def split_areas(world: World, num_vehicles: int, overlap: float) -> list[SurveyArea]:
    """Areas side by side along x; neighbours share the part `overlap` of their width."""
    x_min, y_min, x_max, y_max = world.bounds
    width = (x_max - x_min) / (1.0 + (num_vehicles - 1) * (1.0 - overlap))
    starts = x_min + np.arange(num_vehicles) * width * (1.0 - overlap)
    return [SurveyArea(float(x), y_min, float(x + width), y_max) for x in starts]


def plan_survey(
    world: World,
    area: SurveyArea,
    length_m: float,
    clearance_m: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Route (N, 2) [m], points every 0.25 m, at least as long as asked for.

    A loop along the rim of the area, then legs across it, and again, until it is long enough.

    Raises
    ------
    InvalidInputError
        If the area has no water that can be reached with the clearance.
    """
    spec, clearance = _clearance_map(world)
    is_free = _reachable(clearance >= clearance_m)
    rows, cols = np.nonzero(is_free)
    centers = spec.centers_of(np.column_stack([rows, cols]))
    inside = (
        (centers[:, 0] > area.x_min)
        & (centers[:, 0] < area.x_max)
        & (centers[:, 1] > area.y_min)
        & (centers[:, 1] < area.y_max)
    )
    if inside.sum() < 100:
        raise InvalidInputError(
            f"the area {area} of {world.name} has no water with {clearance_m} m of clearance"
        )
    targets, target_cells = centers[inside], np.column_stack([rows, cols])[inside]
    # Near walls costs more, so routes keep to the middle of a passage.
    cost = np.where(is_free, 1.0 + 4.0 * np.exp(-(clearance - clearance_m) / 2.0), 1e6)
    route: list[FloatArray] = []
    total = 0.0
    here: NDArray[np.int64] | None = None
    while total < length_m:
        for waypoint in _waypoints(area, rng):
            goal = target_cells[np.argmin(((targets - waypoint) ** 2).sum(axis=1))]
            if here is not None and (goal != here).any():
                cells, _ = route_through_array(cost, tuple(here), tuple(goal), geometric=True)
                leg = spec.centers_of(np.array(cells))
                total += float(np.hypot(*np.diff(leg, axis=0).T).sum())
                route.append(leg[1:] if route else leg)
            here = goal
    return _smoothed(np.vstack(route), spec, clearance, 0.6 * clearance_m)


def _clearance_map(world: World) -> tuple[GridSpec, FloatArray]:
    spec = grid_over(world, _CELL_M, 0.0)
    return spec, distance_transform_edt(~wall_mask(world, spec)) * _CELL_M


def _reachable(is_clear: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest connected part of the clear cells; pockets of land and water are smaller."""
    parts, _ = label(is_clear)
    return parts == 1 + np.argmax(np.bincount(parts[is_clear])[1:])


def _waypoints(area: SurveyArea, rng: np.random.Generator) -> FloatArray:
    """One round: the rim, from a random corner in a random direction, then legs across."""
    inset = rng.uniform(7.0, 12.0)
    x0, x1 = area.x_min + inset, area.x_max - inset
    y0, y1 = area.y_min + inset, area.y_max - inset
    middle = rng.uniform(0.4, 0.6)
    rim = np.array(
        [
            (x0, y0),
            (x0 + middle * (x1 - x0), y0 + rng.uniform(0.0, 8.0)),
            (x1, y0),
            (x1, y1),
            (x0 + middle * (x1 - x0), y1 - rng.uniform(0.0, 8.0)),
            (x0, y1),
        ]
    )
    rim = np.roll(rim, int(rng.integers(len(rim))), axis=0)
    if rng.random() < 0.5:
        rim = rim[::-1]
    legs = []
    for i, x in enumerate(np.linspace(x0 + 6.0, x1 - 6.0, 3)):
        ends = [(x, y0 + 5.0), (x, y1 - 5.0)]
        legs += ends if i % 2 == 0 else ends[::-1]
    return np.vstack([rim, rim[:1], np.array(legs)])


def _smoothed(
    route: FloatArray, spec: GridSpec, clearance: FloatArray, min_clearance_m: float
) -> FloatArray:
    """Resample evenly and round the corners, everywhere as much as the clearance allows."""
    route = _resampled(route, _STEP_M)

    def clearance_of(points: FloatArray) -> FloatArray:
        cells = np.clip(spec.cells_of(points), 0, np.array(spec.shape) - 1)
        return clearance[cells[:, 0], cells[:, 1]]

    here = clearance_of(route)
    for _ in range(_NUM_SMOOTHINGS):
        moved = gaussian_filter1d(route, _SMOOTHING_M / _STEP_M, axis=0, mode="nearest")
        there = clearance_of(moved)
        # A point gives way only to where it is clear enough, or clearer than it was; nearly so
        # do its neighbours, lest the route get a kink.
        is_allowed = (there >= min_clearance_m) | (there >= here)
        share = gaussian_filter1d(is_allowed.astype(np.float64), 1.0 / _STEP_M, mode="nearest")
        route = route + (is_allowed * share)[:, None] * (moved - route)
        here = clearance_of(route)
    return _resampled(route, _STEP_M)


def _resampled(route: FloatArray, step_m: float) -> FloatArray:
    lengths = np.hypot(*np.diff(route, axis=0).T)
    route = route[np.concatenate([[True], lengths > 1e-9])]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    even = np.linspace(0.0, s[-1], max(2, math.ceil(s[-1] / step_m) + 1))
    return np.column_stack([np.interp(even, s, route[:, i]) for i in range(2)])
