"""Places to simulate, a different one for every seed: harbours, lake beds, and hard ones."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.waters.world import Surface, World, WorldBuilder, bounds_of

__all__ = [
    "PLACES",
    "make_canal",
    "make_harbour",
    "make_lake",
    "make_place",
    "make_symmetric",
]

FloatArray = NDArray[np.float64]

PLACES = ("harbour", "lake")
"""Names that `make_place` knows."""

CONCRETE = Surface("concrete", 0.0, 4.0)
STEEL = Surface("steel", 1.0, 8.0)
TIMBER = Surface("timber", -7.0, 1.0)
ROCK = Surface("rock", -6.0, 0.0)
RUBBLE = Surface("rubble", -8.0, 0.0)
BANK = Surface("bank", -11.0, 0.0)


def make_place(place: str, seed: int, num_vehicles: int = 3, width_m: float = 0.0) -> World:
    """Build a place of a width; 0 makes it large enough for a number of vehicles."""
    if place == "harbour":
        return make_harbour(seed, num_vehicles, width_m)
    if place == "lake":
        return make_lake(seed, num_vehicles, width_m)
    raise InvalidInputError(f"place is {place!r}, expected one of {', '.join(PLACES)}")


def make_harbour(seed: int, num_vehicles: int = 3, width_m: float = 0.0, twin: int = 0) -> World:
    """Build a basin of quay walls with piers, piles, a moored hull, rocks and a breakwater.

    Twins are basins of one outline, as if built by one plan; all else is each one's own.
    """
    rng = np.random.default_rng([seed, 1])
    width = (width_m or 40.0 + 35.0 * num_vehicles) + rng.uniform(-5.0, 5.0)
    num_things = max(1, round((width - 40.0) / 35.0))
    height = rng.uniform(62.0, 75.0)
    builder = WorldBuilder()
    # Land on three sides, the breakwater on the fourth: the mouth is in its line.
    west, south = _jagged_side(rng, height), _jagged_side(rng, width)
    east = _jagged_side(rng, height)
    outline = np.vstack(
        [
            np.column_stack([west[::-1, 1], height - west[::-1, 0]])[::-1],
            south[1:],
            np.column_stack([width - east[1:, 1], east[1:, 0]]),
        ]
    )
    if twin:
        rng = np.random.default_rng([seed, 1, twin])
    _add_quay(builder, rng, outline)
    _add_breakwater(builder, rng, width, height)
    slots = _slots(rng, width, num_things)
    for i, x in enumerate(slots):
        (_add_pier, _add_piled_jetty, _add_hull)[i % 3](builder, rng, x)
    for x in rng.uniform(12.0, width - 12.0, size=3 + 2 * num_things):
        _add_dolphin(builder, rng, (x, rng.uniform(0.35, 0.9) * height))
    for x in rng.uniform(8.0, width - 8.0, size=4 + 2 * num_things):
        _add_rock(builder, rng, (x, rng.uniform(0.3, 0.95) * height), rng.uniform(0.4, 1.8))
    water_point = (0.5 * width, 0.6 * height)
    return builder.build("harbour", seed, water_point, 8.0)


def make_canal(seed: int, length_m: float = 120.0) -> World:
    """Build two long straight quays with a closed end: little tells where along it one is."""
    rng = np.random.default_rng([seed, 5])
    breadth = rng.uniform(24.0, 36.0)
    builder = WorldBuilder()
    _add_quay(builder, rng, np.array([(0.0, breadth), (0.0, 0.0), (length_m, 0.0)]))
    _add_quay(builder, rng, np.array([(length_m, breadth), (0.0, breadth)]))
    for x in rng.uniform(5.0, length_m - 5.0, size=max(1, round(length_m / 40.0))):
        is_south = rng.random() < 0.5
        _add_dolphin(builder, rng, (float(x), 2.0 if is_south else breadth - 2.0))
    return builder.build("canal", seed, (0.5 * length_m, 0.5 * breadth), 8.0)


def make_symmetric(seed: int, width_m: float = 90.0) -> World:
    """Build a closed basin that is itself again after half a turn, to the last fender."""
    rng = np.random.default_rng([seed, 6])
    height = rng.uniform(50.0, 65.0)
    builder = WorldBuilder()
    west, south = _jagged_side(rng, height), _jagged_side(rng, width_m)
    west = np.column_stack([west[::-1, 1], height - west[::-1, 0]])[::-1]
    _add_quay(builder, rng, np.vstack([west, south[1:]]))
    for i, x in enumerate(rng.uniform(12.0, width_m - 12.0, 3)):
        (_add_pier, _add_piled_jetty, _add_hull)[i](builder, rng, x)
    for _ in range(3):
        spot = rng.uniform((10.0, 10.0), (width_m - 10.0, 0.5 * height))
        _add_rock(builder, rng, (float(spot[0]), float(spot[1])), rng.uniform(0.4, 1.8))
    half = builder.build("symmetric", seed, (0.5 * width_m, 0.5 * height), 8.0)
    turned = np.tile([width_m, height], 2) - half.segments
    segments = np.vstack([half.segments, turned])
    return replace(
        half,
        segments=segments,
        surface_of=np.tile(half.surface_of, 2),
        bounds=bounds_of(segments),
    )


def _jagged_side(rng: np.random.Generator, length: float) -> FloatArray:
    """Points (N, 2) of a quay from (0, 0) to (length, 0), with steps of up to 7 m to y > 0."""
    points = [(0.0, 0.0)]
    x, depth = 0.0, 0.0
    while length - x > 26.0:
        x += rng.uniform(9.0, 22.0)
        new_depth = 0.0 if depth > 0.0 and rng.random() < 0.5 else rng.uniform(1.0, 7.0)
        # Some corners are bevelled: right angles alone look alike after a quarter turn.
        bevel = rng.choice([0.0, 0.0, rng.uniform(1.0, 5.0)])
        points += [(x, depth), (x + bevel, new_depth)]
        x, depth = x + bevel, new_depth
    if depth > 0.0:
        points += [(length - 3.0, depth), (length - 3.0, 0.0)]
    points.append((length, 0.0))
    return np.array(points)


def _add_quay(builder: WorldBuilder, rng: np.random.Generator, outline: FloatArray) -> None:
    """Quay wall with fenders and ladder recesses at uneven distances; water lies to its left."""
    for start, end in itertools.pairwise(outline):
        length = float(np.hypot(*(end - start)))
        if length < 1e-6:
            continue
        surface = STEEL if rng.random() < 0.3 else CONCRETE
        along = (end - start) / length
        inward = np.array([-along[1], along[0]])
        points = [start]
        s = rng.uniform(2.0, 6.0)
        while s < length - 2.0:
            half = rng.uniform(0.2, 0.5)
            out = rng.uniform(0.3, 0.7) * rng.choice([1.0, 1.0, -1.0])
            points += [
                start + (s - half) * along,
                start + (s - half) * along + out * inward,
                start + (s + half) * along + out * inward,
                start + (s + half) * along,
            ]
            s += rng.uniform(3.0, 11.0)
        builder.add(surface, [*points, end])


def _add_breakwater(
    builder: WorldBuilder, rng: np.random.Generator, width: float, height: float
) -> None:
    """Two rubble arms that leave a mouth; behind the mouth there is open water."""
    mouth = rng.uniform(0.25, 0.75) * width
    half = rng.uniform(6.0, 9.0)
    for x_from, x_to in ((0.0, mouth - half), (mouth + half, width)):
        count = max(4, int((x_to - x_from) / 1.3))
        xs = np.linspace(x_from, x_to, count)
        bend = rng.uniform(-3.0, 3.0) * np.sin(np.linspace(0.0, math.pi, count))
        inner = height + bend + rng.normal(0.0, 0.35, count)
        builder.add(RUBBLE, np.column_stack([xs, inner]))
        tip = xs[-1] if x_to < mouth else xs[0]
        tip_y = inner[-1] if x_to < mouth else inner[0]
        angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 7)
        sign = 1.0 if x_to < mouth else -1.0
        radius = 2.5 + rng.normal(0.0, 0.2, 7)
        radius[0] = 2.5
        head = np.column_stack(
            [tip + sign * radius * np.cos(angles), tip_y + 2.5 + radius * np.sin(angles)]
        )
        builder.add(RUBBLE, head)


def _slots(rng: np.random.Generator, width: float, num_things: int) -> FloatArray:
    """Places along the south quay for piers, jetties and hulls, apart from each other."""
    count = 2 + 2 * num_things
    step = (width - 24.0) / count
    slots = 12.0 + step * (np.arange(count) + 0.5) + rng.uniform(-0.2, 0.2, count) * step
    return rng.permutation(slots)


def _add_pier(builder: WorldBuilder, rng: np.random.Generator, x: float) -> None:
    """Solid pier off the south quay, slightly askew, with an L-shaped head now and then."""
    length, half = rng.uniform(12.0, 24.0), rng.uniform(1.2, 2.2)
    shape = [(-half, -2.0), (-half, length)]
    if rng.random() < 0.5:
        reach = rng.uniform(3.0, 7.0) * rng.choice([-1.0, 1.0])
        if reach < 0.0:
            shape = [(-half, -2.0), (-half, length - 2 * half), (-half + reach, length - 2 * half)]
            shape += [(-half + reach, length), (half, length), (half, -2.0)]
        else:
            shape += [(half + reach, length), (half + reach, length - 2 * half)]
            shape += [(half, length - 2 * half), (half, -2.0)]
    else:
        shape += [(half, length), (half, -2.0)]
    builder.add(CONCRETE, _placed(shape, (x, 0.0), rng.uniform(-0.2, 0.2)))


def _add_piled_jetty(builder: WorldBuilder, rng: np.random.Generator, x: float) -> None:
    """Two rows of piles, of which a few are missing."""
    length, half = rng.uniform(12.0, 26.0), rng.uniform(1.2, 2.0)
    angle = rng.uniform(-0.25, 0.25)
    spacing, radius = rng.uniform(2.6, 4.2), rng.uniform(0.18, 0.4)
    surface = TIMBER if rng.random() < 0.5 else STEEL
    for y in np.arange(4.0, length, spacing):
        for side in (-half, half):
            if rng.random() < 0.88:
                center = _placed([(side, y)], (x, 3.0), angle)[0]
                builder.add(surface, _circle(center, radius, 8), is_closed=True)


def _add_hull(builder: WorldBuilder, rng: np.random.Generator, x: float) -> None:
    """Ship's hull at a berth: pointed bow, square stern, along or off the quay."""
    length, half = rng.uniform(14.0, 26.0), rng.uniform(1.8, 3.2)
    side = np.linspace(0.0, 1.0, 9)
    beam = half * np.minimum(1.0, 1.8 * (1.0 - side)) ** 0.6
    port = np.column_stack([side * length - 0.5 * length, beam])
    hull = np.vstack([port, port[-2::-1] * (1.0, -1.0)])
    angle = rng.choice([0.0, math.pi]) + rng.uniform(-0.1, 0.1)
    y = 7.0 + half + rng.uniform(0.8, 2.0)
    builder.add(STEEL, _placed(hull, (x, y), angle), is_closed=True)


def _add_dolphin(
    builder: WorldBuilder, rng: np.random.Generator, center: tuple[float, float]
) -> None:
    """Mooring dolphin: one to three thick piles."""
    for _ in range(rng.integers(1, 4)):
        offset = rng.normal(0.0, 0.9, 2)
        builder.add(STEEL, _circle(center + offset, rng.uniform(0.25, 0.5), 10), is_closed=True)


def _add_rock(
    builder: WorldBuilder,
    rng: np.random.Generator,
    center: tuple[float, float],
    radius: float,
) -> None:
    """Boulder with an uneven outline."""
    count = int(rng.integers(7, 13))
    angles = np.sort(rng.uniform(0.0, 2.0 * math.pi, count))
    radii = radius * rng.uniform(0.6, 1.3, count)
    stretch = rng.uniform(0.6, 1.0)
    shape = np.column_stack([radii * np.cos(angles), stretch * radii * np.sin(angles)])
    builder.add(ROCK, _placed(shape, center, rng.uniform(0.0, math.pi)), is_closed=True)


def make_lake(seed: int, num_vehicles: int = 3, width_m: float = 0.0) -> World:
    """Build an open lake bed: a winding bank on one side, a few boulders, a wreck, stakes."""
    rng = np.random.default_rng([seed, 2])
    width = width_m or 40.0 + 35.0 * num_vehicles
    num_things = max(1, round((width - 40.0) / 35.0))
    height = rng.uniform(60.0, 75.0)
    builder = WorldBuilder()
    xs = np.arange(-10.0, width + 10.0, 1.5)
    phases = rng.uniform(0.0, 2.0 * math.pi, 4)
    waves = [(5.0, 55.0), (2.5, 23.0), (1.0, 9.0), (0.4, 4.0)]
    bank = sum(
        a * np.sin(2.0 * math.pi * xs / w + p) for (a, w), p in zip(waves, phases, strict=True)
    )
    builder.add(BANK, np.column_stack([xs, bank + rng.normal(0.0, 0.15, len(xs))]))
    for _ in range(2 + 2 * num_things):
        center = (rng.uniform(5.0, width - 5.0), rng.uniform(16.0, height - 5.0))
        for _ in range(rng.integers(1, 6)):
            spot = (center[0] + rng.normal(0.0, 2.5), center[1] + rng.normal(0.0, 2.5))
            _add_rock(builder, rng, spot, rng.uniform(0.3, 1.6))
    wreck = (rng.uniform(0.3, 0.7) * width, rng.uniform(0.45, 0.7) * height)
    side = np.linspace(0.0, 1.0, 9)
    beam = 1.8 * np.minimum(1.0, 1.8 * (1.0 - side)) ** 0.6
    port = np.column_stack([side * 12.0 - 6.0, beam])
    hull = np.vstack([port, port[-2::-1] * (1.0, -1.0)])
    builder.add(TIMBER, _placed(hull, wreck, rng.uniform(0.0, math.pi)), is_closed=True)
    for x in rng.uniform(5.0, width - 5.0, 2 * num_things):
        builder.add(TIMBER, _circle((x, rng.uniform(9.0, 16.0)), 0.15, 6), is_closed=True)
    return builder.build("lake", seed, (0.5 * width, height - 2.0), 7.0)


def _circle(center: object, radius: float, count: int) -> FloatArray:
    angles = 2.0 * math.pi * np.arange(count) / count
    return np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def _placed(points: object, center: tuple[float, float], angle_rad: float) -> FloatArray:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.asarray(points, dtype=np.float64) @ np.array([[cos, sin], [-sin, cos]]) + center
