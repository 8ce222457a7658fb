"""Quick random buildings as rasters, of the kinds that robots with a lidar map at 0.05 m.

Lengths are in cells of that size: corridors are two metres wide and rooms four deep. Outer walls
have windows, through which rays leave and draw the streaks of such maps.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["draw_cellular", "draw_corridors", "draw_hall", "draw_oblique"]

ByteGrid = NDArray[np.uint8]
FloatArray = NDArray[np.float64]


def draw_corridors(size: int, rng: np.random.Generator) -> ByteGrid:
    """Corridors that meet at right angles, with rows of rooms to both sides, as an institute."""
    image = np.zeros((size, size), np.uint8)
    width, depth = int(rng.integers(32, 52)), int(rng.integers(75, 130))
    pitch = width + 2 * depth
    first = int(rng.integers(0, depth))
    for y in range(first, size, pitch):
        for edge, side in ((y, -1), (y + width, 1)):
            _room_row(image, edge, side, depth, rng)
    for _ in range(int(rng.integers(1, 3))):
        x = int(rng.integers(size // 8, size * 7 // 8))
        image[:, x : x + width] = 0
        for edge in (x, x + width):
            _wall(image, (edge, 0), (edge, size - 1), rng)
        for y in range(first, size, pitch):
            image[y + 3 : y + width - 2, x - 3 : x + width + 4] = 0
    _furnish(image, rng, rng.uniform(2500, 9000))
    return image


def _room_row(image: ByteGrid, edge: int, side: int, depth: int, rng: np.random.Generator) -> None:
    """Rooms along a corridor's edge at row ``edge``, each with a door; some shut."""
    size = image.shape[0]
    back = edge + side * depth
    _wall(image, (0, edge), (size - 1, edge), rng)
    _wall(image, (0, back), (size - 1, back), rng)
    usual, x = int(rng.integers(50, 90)), int(rng.integers(0, 40))
    while x < size:
        room = int(usual * rng.choice([1.0, 1.0, 1.5, 2.0]) + rng.integers(-4, 5))
        _wall(image, (x, edge), (x, back), rng)
        if rng.random() < 0.85:
            door = x + int(rng.integers(4, max(5, room - 22)))
            image[max(edge - 5, 0) : edge + 6, door : door + int(rng.integers(16, 22))] = 0
        if rng.random() < 0.3:  # a desk or a shelf along a wall
            start, end = sorted((edge + side * 8, back))
            shelf = int(rng.integers(8, 16))
            image[max(start, 0) : max(end, 0), x : x + shelf] = 1
        x += room


def draw_oblique(size: int, rng: np.random.Generator) -> ByteGrid:
    """Rooms between walls of few directions that are not at right angles, and curved walls."""
    image = np.zeros((size, size), np.uint8)
    directions = rng.uniform(0.0, math.pi, int(rng.integers(2, 5)))
    for _ in range(int(size * rng.uniform(0.02, 0.035))):
        angle = float(rng.choice(directions))
        start = rng.uniform(0, size, 2)
        end = start + rng.uniform(60, 260) * np.array([math.cos(angle), math.sin(angle)])
        _wall(image, start, end, rng)
    for _ in range(int(rng.integers(3, 8))):
        center, radius = rng.uniform(0, size, 2), int(rng.integers(30, 140))
        start_deg = float(rng.uniform(0, 360))
        cv2.ellipse(
            image, _ints(center), (radius, radius), 0.0, start_deg,
            start_deg + float(rng.uniform(50, 220)), 1, int(rng.integers(2, 5)),
        )  # fmt: skip
    _doors(image, rng, int(size * size / 8000))
    _furnish(image, rng, rng.uniform(2500, 7000))
    return image


def draw_hall(size: int, rng: np.random.Generator) -> ByteGrid:
    """A big hall: columns on a lattice, stalls, legs of chairs and tables, a few rooms."""
    image = np.zeros((size, size), np.uint8)
    spacing, angle = rng.uniform(70, 130), rng.uniform(0, math.pi)
    axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    half, is_round = int(rng.integers(3, 8)), rng.random() < 0.5
    lattice = np.arange(-15, 16) * spacing
    for column in np.stack(np.meshgrid(lattice, lattice), axis=-1).reshape(-1, 2):
        center = size / 2 + column @ axes
        if is_round:
            cv2.circle(image, _ints(center), half, 1, -1)
        else:
            _box(image, center, (2.0 * half, 2.0 * half), math.degrees(angle))
    for _ in range(int(rng.integers(8, 20))):  # stalls: three walls of a box
        corner, box = rng.uniform(0, size, 2), rng.uniform(30, 120, 2)
        turn = axes if rng.random() < 0.7 else axes[::-1] * (1.0, -1.0)
        outline = corner + np.array([[0, 0], [box[0], 0], box, [0, box[1]]]) @ turn
        for a, b in itertools.pairwise(outline):
            _wall(image, a, b, rng)
    for _ in range(int(size * size / rng.uniform(3000, 8000))):
        cv2.circle(image, _ints(rng.uniform(0, size, 2)), int(rng.integers(0, 3)), 1, -1)
    _furnish(image, rng, rng.uniform(5000, 12000))
    return image


def draw_cellular(size: int, rng: np.random.Generator) -> ByteGrid:
    """A lab: one floor of rooms of all sizes, much clutter, walls that are seldom bare."""
    image = np.zeros((size, size), np.uint8)
    xs = np.cumsum(rng.integers(50, 150, size // 50))
    for x0, x1 in zip(np.r_[0, xs[:-1]], xs, strict=True):
        if x0 >= size:
            break
        _wall(image, (x0, 0), (x0, size - 1), rng)
        for y in np.cumsum(rng.integers(45, 160, size // 45)):
            _wall(image, (x0, y), (x1, y), rng)
    _doors(image, rng, int(size * size / 5000))
    _furnish(image, rng, rng.uniform(1200, 3000))
    return image


def _wall(
    image: ByteGrid,
    start: FloatArray | tuple[float, float],
    end: FloatArray | tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """A wall [x, y], with a window, a niche or a pillar here and there."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    cv2.line(image, _ints(first), _ints(last), 1, int(rng.integers(1, 5)))
    length = float(np.hypot(*(last - first)))
    for _ in range(int(rng.poisson(length / 150.0))):
        place = first + rng.uniform(0.0, 1.0) * (last - first)
        step = (last - first) / max(length, 1.0)
        if rng.random() < 0.4:
            cv2.line(image, _ints(place), _ints(place + rng.uniform(6, 30) * step), 0, 6)
        else:
            side = float(rng.uniform(4, 12))
            _box(image, place, (side, side), math.degrees(math.atan2(step[1], step[0])))


def _doors(image: ByteGrid, rng: np.random.Generator, count: int) -> None:
    rows, cols = np.nonzero(image)
    for index in rng.integers(0, len(rows), count):
        cv2.circle(image, (int(cols[index]), int(rows[index])), int(rng.integers(8, 12)), 0, -1)


def _furnish(image: ByteGrid, rng: np.random.Generator, cells_each: float) -> None:
    """Furniture, one piece on so many cells; most of it stands along a few directions."""
    size = image.shape[0]
    usual = float(rng.choice([0.0, 0.0, rng.uniform(0, 90)]))
    for _ in range(int(size * size / cells_each)):
        center = rng.uniform(0, size, 2)
        if rng.random() < 0.3:
            cv2.circle(image, _ints(center), int(rng.integers(1, 6)), 1, -1)
            continue
        angle = usual if rng.random() < 0.7 else float(rng.uniform(0, 90))
        _box(image, center, tuple(rng.uniform(4, 30, 2)), angle)


def _box(image: ByteGrid, center: FloatArray, box: tuple[float, ...], angle_deg: float) -> None:
    corners = cv2.boxPoints(
        ((float(center[0]), float(center[1])), (float(box[0]), float(box[1])), angle_deg)
    )
    cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], 1)


def _ints(point: FloatArray) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
