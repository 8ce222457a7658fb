"""Pairs of occupancy maps with known answers, for studies of the registration.

What a vehicle would have seen of a place is cut into windows that overlap by a given share, turned
by any angle, and damaged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.floor_plans import BASIN_MARGIN, make_place

__all__ = [
    "NOISES",
    "MapNoise",
    "MapPair",
    "cut_pair",
    "cut_window",
    "damage",
    "is_right",
    "make_pair",
    "observe",
    "pair_errors",
    "windows_about",
]

Values = NDArray[np.int8]
_BEND_CELLS = 300
_RIGHT_CELLS = 6.0
_RIGHT_RAD = math.radians(2.0)
_BUILDINGS = ("corridors", "oblique", "hall", "cellular")


@dataclass(frozen=True, slots=True)
class MapNoise:
    """Damage done to a window; shares of cells, distances in cells."""

    speckle: float = 0.0  # of all cells, set to wall, free or unknown at random
    wiped: float = 0.0  # of wall cells, made free
    moved: float = 0.0  # of wall cells, moved to a neighbouring cell
    bend_cells: float = 0.0  # greatest displacement of a smooth bend

    def __post_init__(self) -> None:
        for name in ("speckle", "wiped", "moved"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidInputError(f"{name} is {getattr(self, name)}, expected 0 to 1")


NOISES = {
    "clean": MapNoise(),
    "noisy": MapNoise(0.01, 0.15, 0.15, 1.0),
    "hard": MapNoise(0.03, 0.35, 0.30, 3.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class MapPair:
    """Two maps; ``T_target_source`` is None where they do not show the same place.

    ``middle_m`` (2,) is the point of the source's frame at which an answer's error is measured,
    the map's middle where None. An answer that is off by less than ``tolerance_m`` and
    ``tolerance_rad`` is right.
    """

    kind: str
    noise: str
    overlap: float  # share of the window's area that both windows cover
    source: OccupancyMap
    target: OccupancyMap
    T_target_source: SE2 | None
    is_ambiguous: bool = False
    middle_m: tuple[float, float] | None = None
    tolerance_m: float | None = None  # six of the source's cells where None
    tolerance_rad: float = _RIGHT_RAD


@njit(cache=True, nogil=True)
def _cast_rays(
    solid: NDArray[np.bool_], seen: Values, x: float, y: float, angles: NDArray[np.float64],
    range_cells: float,
) -> None:  # fmt: skip
    """Mark what rays from (x, y) [cells] see: free on the way, a wall where they end."""
    num_rows, num_cols = solid.shape
    for k in range(angles.shape[0]):
        dx, dy = 0.7 * math.cos(angles[k]), 0.7 * math.sin(angles[k])
        px, py = x, y
        for _ in range(int(range_cells / 0.7)):
            col, row = math.floor(px), math.floor(py)
            if row < 0 or col < 0 or row >= num_rows or col >= num_cols:
                break
            if solid[row, col]:
                seen[row, col] = 100
                break
            if seen[row, col] < 0:
                seen[row, col] = 0
            px += dx
            py += dy


def observe(
    solid: NDArray[np.bool_],
    rng: np.random.Generator,
    *,
    num_views: int = 60,
    range_cells: float = 240.0,
    view_rad: float = 2.0 * math.pi,
    dropout: float = 0.0,
) -> Values:
    """Occupancy values (R, C) that looks from random free cells gather; the rest stays unknown.

    ``view_rad`` below a full turn and ``dropout`` (share of rays without any return) give the
    holes and shadows of sonar maps.
    """
    seen = np.full(solid.shape, UNKNOWN, np.int8)
    rows, cols = np.nonzero(~cv2.dilate(solid.astype(np.uint8), np.ones((7, 7))).astype(bool))
    if len(rows) == 0:
        return seen
    num_rays = int(2.2 * range_cells * view_rad)
    for index in rng.integers(0, len(rows), num_views):
        start = rng.uniform(-math.pi, math.pi)
        angles = start + np.linspace(0.0, view_rad, num_rays, endpoint=False)
        if dropout > 0.0:
            # Dropouts come in fans of neighbouring beams, as noise and interference do.
            fans = np.repeat(rng.random(num_rays // 20 + 1) >= dropout, 20)[:num_rays]
            angles = angles[fans]
        _cast_rays(solid, seen, cols[index] + 0.5, rows[index] + 0.5, angles, range_cells)
    return seen


def damage(values: Values, noise: MapNoise, rng: np.random.Generator) -> Values:
    """A damaged copy of occupancy values (R, C)."""
    result = values.copy()
    if noise.bend_cells > 0.0:
        result = _bend(result, noise.bend_cells, rng)
    rows, cols = np.nonzero(result == OCCUPIED)
    draw = rng.random(len(rows))
    is_wiped = draw < noise.wiped
    is_moved = (draw >= noise.wiped) & (draw < noise.wiped + noise.moved)
    for selection in (is_wiped, is_moved):
        result[rows[selection], cols[selection]] = FREE
    steps = rng.integers(-1, 2, (int(is_moved.sum()), 2))
    moved_rows = np.clip(rows[is_moved] + steps[:, 0], 0, values.shape[0] - 1)
    moved_cols = np.clip(cols[is_moved] + steps[:, 1], 0, values.shape[1] - 1)
    result[moved_rows, moved_cols] = OCCUPIED
    speckled = rng.random(values.shape) < noise.speckle
    choices = np.array([UNKNOWN, FREE, OCCUPIED], np.int8)
    result[speckled] = rng.choice(choices, int(speckled.sum()))
    return result


def _bend(values: Values, bend_cells: float, rng: np.random.Generator) -> Values:
    shape = values.shape
    rows, cols = np.indices(shape, dtype=np.float32)
    step = -(-max(shape) // _BEND_CELLS)  # so smooth a field needs no more
    small = tuple(-(-size // step) for size in shape)
    shifts = []
    for _ in range(2):
        field = rng.standard_normal(small).astype(np.float32)
        field = cv2.GaussianBlur(field, (0, 0), max(small) / 5.0, borderType=cv2.BORDER_REFLECT)
        field = cv2.resize(field, shape[::-1], interpolation=cv2.INTER_LINEAR)
        field -= field.mean()
        shifts.append(field * np.float32(bend_cells / max(float(np.abs(field).max()), 1e-12)))
    limit = np.float32(math.sqrt(0.5))
    image = values.astype(np.int16)
    bent = cv2.remap(
        image, cols + limit * shifts[0], rows + limit * shifts[1],
        cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN,
    )  # fmt: skip
    return bent.astype(np.int8)


def cut_window(values: Values, T_world_window: SE2, size_cells: int) -> Values:
    """Window of a world's values; poses in cells, nearest cell, unknown outside."""
    rows, cols = np.indices((size_cells, size_cells))
    centers = np.column_stack([cols.ravel() + 0.5, rows.ravel() + 0.5])
    cells = np.floor(T_world_window.apply(centers)).astype(np.int64)
    inside = (cells >= 0).all(axis=1) & (cells < values.shape[::-1]).all(axis=1)
    result = np.full(size_cells * size_cells, UNKNOWN, np.int8)
    result[inside] = values[cells[inside, 1], cells[inside, 0]]
    return result.reshape(size_cells, size_cells)


def _window_overlap(T_a_b: SE2, size: float) -> float:
    square = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float32)
    moved = T_a_b.apply(square).astype(np.float32)
    area, _ = cv2.intersectConvexConvex(square, moved)
    return float(area) / size**2


def _place_windows(
    world_cells: int, size_cells: int, overlap: float, rng: np.random.Generator
) -> tuple[SE2, SE2]:
    """Poses of two windows inside a world that overlap by the wanted share, in cells."""
    half = size_cells / 2.0
    for _ in range(200):
        yaw_a, yaw_b, heading = rng.uniform(-math.pi, math.pi, 3)
        margin = half * 1.1
        center = rng.uniform(margin, world_cells - margin, 2)
        T_a, T_b = windows_about(center, (yaw_a, yaw_b), heading, size_cells, overlap)
        other = T_b.apply(np.array([[half, half]]))[0]
        if (other > margin).all() and (other < world_cells - margin).all():
            break
    return T_a, T_b


def windows_about(
    center: NDArray[np.float64],
    yaws: tuple[float, float],
    heading: float,
    size_cells: int,
    overlap: float,
) -> tuple[SE2, SE2]:
    """Poses of a window about a place and of one in a direction that it overlaps by a share.

    In cells of the map that they are cut from.
    """
    half = size_cells / 2.0
    yaw_a, yaw_b = yaws
    T_a = _window_at(center, yaw_a, half)
    low, high = 0.0, 2.0 * size_cells
    for _ in range(40):  # bisection: the overlap falls with the distance
        distance = (low + high) / 2.0
        other = center + distance * np.array([math.cos(heading), math.sin(heading)])
        T_b = _window_at(other, yaw_b, half)
        if _window_overlap(T_a.inverse() @ T_b, size_cells) > overlap:
            low = distance
        else:
            high = distance
    return T_a, T_b


def _window_at(center: NDArray[np.float64], yaw: float, half: float) -> SE2:
    return SE2(float(center[0]), float(center[1]), yaw) @ SE2(-half, -half, 0.0)


def cut_pair(
    values_a: Values,
    values_b: Values,
    kind: str,
    overlap: float,
    noise: str,
    rng: np.random.Generator,
    *,
    size_cells: int = 260,
    resolution_m: float = 0.05,
    is_matching: bool = True,
    T_world_windows: tuple[SE2, SE2] | None = None,
) -> MapPair:
    """Cut windows out of two observations (R, R) of a place, damage them, give them own frames.

    With ``is_matching`` false the observations are of different places and the pair has no answer.
    ``T_world_windows`` are the windows' poses in cells; at random, ``overlap`` apart, where None.
    """
    T_world_a, T_world_b = T_world_windows or _place_windows(
        values_a.shape[0], size_cells, overlap, rng
    )
    maps, specs = [], []
    for values, T_world_window in ((values_a, T_world_a), (values_b, T_world_b)):
        window = damage(cut_window(values, T_world_window, size_cells), NOISES[noise], rng)
        spec = GridSpec(
            resolution_m,
            size_cells,
            size_cells,
            SE2(rng.uniform(-50.0, 50.0), rng.uniform(-50.0, 50.0), 0.0),
        )
        specs.append(spec)
        maps.append(OccupancyMap(spec, window))
    T_b_a = T_world_b.inverse() @ T_world_a
    T_cells = SE2(T_b_a.x * resolution_m, T_b_a.y * resolution_m, T_b_a.yaw)
    T_target_source = specs[1].T_frame_grid @ T_cells @ specs[0].T_frame_grid.inverse()
    return MapPair(
        kind, noise, overlap, maps[0], maps[1], T_target_source if is_matching else None
    )


def make_pair(
    kind: str,
    overlap: float,
    noise: str,
    seed: int,
    *,
    size_cells: int = 260,
    resolution_m: float = 0.05,
    is_matching: bool = True,
    is_sonar: bool = False,
    is_alias: bool = False,
) -> MapPair:
    """A pair of a generated place; same arguments, same pair.

    ``is_sonar`` observes the place twice, each time with few narrow looks and dropped beams, so
    that the maps have holes and see different things; otherwise both windows are cut from one good
    map. ``is_alias`` puts one window where the place, seen after a half turn, looks like what the
    other window shows, so that the pair seems to match and does not (kind basin only).

    Raises
    ------
    InvalidInputError
        For an unknown kind or noise, or an alias of a place that has none.
    """
    if noise not in NOISES:
        raise InvalidInputError(f"noise is {noise!r}, expected one of {', '.join(NOISES)}")
    if is_alias and kind != "basin":
        raise InvalidInputError(f"kind is {kind!r}, expected basin: others have no alias")
    rng = np.random.default_rng((seed, sum(kind.encode()), size_cells))
    world_cells = int(size_cells * 2.4)
    solid = make_place(kind, world_cells, rng)
    other = solid if is_matching or is_alias else make_place(kind, world_cells, rng)
    reach = size_cells * 0.9
    if is_sonar:
        looks = {"num_views": 90, "view_rad": math.radians(130.0), "dropout": 0.15}
        values_a = observe(solid, rng, range_cells=reach * 0.7, **looks)  # type: ignore[arg-type]
        values_b = observe(other, rng, range_cells=reach * 0.7, **looks)  # type: ignore[arg-type]
    else:
        # A robot looks into some rooms only.
        views = int(rng.integers(12, 60)) if kind in _BUILDINGS else 60
        values_a = observe(solid, rng, range_cells=reach, num_views=views)
        values_b = (
            values_a if other is solid else observe(other, rng, range_cells=reach, num_views=views)
        )
    windows = None
    if kind == "basin":
        windows = _windows_at_an_end(world_cells, size_cells, overlap, rng)
        if is_alias:
            half_turn = SE2(float(world_cells), float(world_cells), math.pi)
            windows = (windows[0], half_turn @ windows[1])
    pair = cut_pair(
        values_a, values_b, kind, overlap, noise, rng,
        size_cells=size_cells, resolution_m=resolution_m,
        is_matching=is_matching and not is_alias, T_world_windows=windows,
    )  # fmt: skip
    return replace(pair, is_ambiguous=kind in ("symmetric", "basin"))


def _windows_at_an_end(
    world_cells: int, size_cells: int, overlap: float, rng: np.random.Generator
) -> tuple[SE2, SE2]:
    """Poses of two windows about one end of a basin that lies along x, in cells."""
    half = size_cells / 2.0
    end = np.array([BASIN_MARGIN * world_cells + 0.35 * size_cells, 0.5 * world_cells])
    first, heading = end + rng.normal(0.0, 0.08 * size_cells, 2), rng.uniform(-math.pi, math.pi)
    step = size_cells * (1.0 - overlap) * np.array([math.cos(heading), math.sin(heading)])
    yaws = rng.uniform(-math.pi, math.pi, 2)
    return _window_at(first, yaws[0], half), _window_at(first + step, yaws[1], half)


def pair_errors(pair: MapPair, T_target_source: SE2 | None) -> tuple[float, float]:
    """Errors at the pair's middle [m], in rotation [rad]; infinite without truth or pose."""
    if pair.T_target_source is None or T_target_source is None:
        return math.inf, math.inf
    middle = np.array(pair.middle_m or pair.source.spec.corners().mean(axis=0))
    offset = T_target_source.apply(middle) - pair.T_target_source.apply(middle)
    return float(np.hypot(*offset)), T_target_source.distance_to(pair.T_target_source)[1]


def is_right(pair: MapPair, T_target_source: SE2 | None) -> bool:
    """Within the pair's tolerances: if it has none, 2 degrees and 0.30 m at 0.05 m a cell."""
    error_m, error_rad = pair_errors(pair, T_target_source)
    tolerance_m = pair.tolerance_m or _RIGHT_CELLS * pair.source.spec.resolution_m
    return error_rad < pair.tolerance_rad and error_m < tolerance_m
