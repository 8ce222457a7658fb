"""Quick random places as rasters: offices, harbours, lakes, caves, and symmetric ones.

They differ from each other in what makes registration hard (right angles, repetition, curves,
clutter), and serve studies of the registration only; `uw_dslam_ros2.sim.waters.places` makes the
places in which vehicles swim.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.maps.buildings import draw_cellular, draw_corridors, draw_hall, draw_oblique

__all__ = ["BASIN_MARGIN", "PLACE_KINDS", "make_place"]

BoolGrid = NDArray[np.bool_]
PLACE_KINDS = (
    "office",
    "corridors",
    "oblique",
    "hall",
    "cellular",
    "harbour",
    "lake",
    "cave",
    "symmetric",
    "basin",
)
BASIN_MARGIN = 0.1
"""Land to either end of a basin, share of the place's side."""


def make_place(kind: str, size_cells: int, rng: np.random.Generator) -> BoolGrid:
    """Solid cells (size_cells, size_cells) of a random place; ``kind`` is one of `PLACE_KINDS`."""
    makers = {
        "office": _office,
        "corridors": draw_corridors,
        "oblique": draw_oblique,
        "hall": draw_hall,
        "cellular": draw_cellular,
        "harbour": _harbour,
        "lake": _lake,
        "cave": _cave,
        "symmetric": _symmetric,
        "basin": _basin,
    }
    if kind not in makers:
        raise InvalidInputError(f"kind is {kind!r}, expected one of {', '.join(PLACE_KINDS)}")
    image = makers[kind](size_cells, rng)
    image[:2], image[-2:], image[:, :2], image[:, -2:] = 1, 1, 1, 1
    return image > 0


def _office(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    image = np.zeros((size, size), np.uint8)
    _split_rooms(image, (0, 0, size - 1, size - 1), rng, int(rng.integers(70, 130)))
    for _ in range(int(size * size / rng.uniform(2500, 6000))):
        _furniture(image, rng)
    return image


def _split_rooms(
    image: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    rng: np.random.Generator,
    room_cells: int,
) -> None:
    """Split a rectangle (x0, y0, x1, y1) by walls with doors, now and then by a corridor."""
    x0, y0, x1, y1 = box
    width, height = x1 - x0, y1 - y0
    if max(width, height) < room_cells * rng.uniform(1.2, 2.0) or min(width, height) < 45:
        return
    is_vertical = width > height if rng.random() < 0.85 else rng.random() < 0.5
    length = width if is_vertical else height
    corridor = int(rng.integers(26, 50)) if length > 2.2 * room_cells else 0
    cut = int(length * rng.uniform(0.3, 0.7)) - corridor // 2
    near = (x0, y0, x0 + cut, y1) if is_vertical else (x0, y0, x1, y0 + cut)
    far_start = cut + corridor
    far = (x0 + far_start, y0, x1, y1) if is_vertical else (x0, y0 + far_start, x1, y1)
    for offset in {cut, far_start}:
        _wall_with_doors(image, box, is_vertical, offset, rng, room_cells)
    _split_rooms(image, near, rng, room_cells)
    _split_rooms(image, far, rng, room_cells)


def _wall_with_doors(
    image: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    is_vertical: bool,
    offset: int,
    rng: np.random.Generator,
    room_cells: int,
) -> None:
    x0, y0, x1, y1 = box
    length = y1 - y0 if is_vertical else x1 - x0
    thick = int(rng.integers(2, 6))
    line = np.ones((length, thick), np.uint8)
    for _ in range(max(1, int(length / (room_cells * rng.uniform(0.8, 1.6))))):
        start = int(rng.integers(2, max(3, length - 24)))
        line[start : start + int(rng.integers(16, 24))] = 0
    if is_vertical:
        image[y0:y1, x0 + offset : x0 + offset + thick] |= line[:, : image.shape[1] - x0 - offset]
    else:
        image[y0 + offset : y0 + offset + thick, x0:x1] |= line.T[: image.shape[0] - y0 - offset]


def _furniture(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    center = rng.uniform(0, image.shape[0], 2)
    if rng.random() < 0.35:
        cv2.circle(image, _ints(center), int(rng.integers(1, 6)), 1, -1)
        return
    size = rng.uniform(5, 36, 2)
    angle = rng.choice([0.0, 90.0, rng.uniform(0, 90)])
    corners = cv2.boxPoints((tuple(center), tuple(size), float(angle)))
    cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], 1)


def _ints(point: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def _harbour(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    image = np.zeros((size, size), np.uint8)
    for side in range(4):
        if rng.random() < 0.75:
            _quay(image, side, rng)
    for _ in range(int(rng.integers(4, 9))):
        _hull(image, rng)
    for _ in range(int(rng.integers(2, 6))):
        _pile_row(image, rng)
    _rubble(image, rng)
    return image


def _quay(image: NDArray[np.uint8], side: int, rng: np.random.Generator) -> None:
    """Land along one side with a jagged quay and piers that reach into the water."""
    size = image.shape[0]
    land = np.zeros_like(image)
    depth = size * rng.uniform(0.06, 0.2)
    x = 0
    while x < size:
        step = int(rng.integers(size // 10, size // 3))
        land[: int(depth), x : x + step] = 1
        if rng.random() < 0.7:
            pier = int(rng.integers(8, 26))
            reach = int(depth + size * rng.uniform(0.08, 0.3))
            land[:reach, x + step // 3 : x + step // 3 + pier] = 1
            if rng.random() < 0.3:
                land[reach - pier : reach, x + step // 3 : x + step // 3 + 3 * pier] = 1
        depth = float(np.clip(depth + rng.normal(0, size * 0.04), 4, size * 0.25))
        x += step
    tilt = cv2.getRotationMatrix2D((size / 2, size / 2), float(rng.normal(0, 4)), 1.0)
    land = cv2.warpAffine(
        land, tilt, (size, size), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    image |= np.rot90(land, side)


def _hull(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    length, beam = rng.uniform(50, 170), rng.uniform(14, 40)
    t = np.linspace(0, 1, 20)
    half = beam / 2 * np.minimum(1.0, 1.6 * np.sqrt(1 - t))
    outline = np.concatenate(
        [np.column_stack([t * length, half]), np.column_stack([t * length, -half])[::-1]]
    )
    angle = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = outline @ rotation.T + rng.uniform(0, image.shape[0], 2)
    cv2.fillPoly(image, [np.rint(points).astype(np.int32)], 1)


def _pile_row(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    start = rng.uniform(0, image.shape[0], 2)
    angle, spacing = rng.uniform(0, 2 * math.pi), rng.uniform(14, 50)
    direction = np.array([math.cos(angle), math.sin(angle)])
    for k in range(int(rng.integers(4, 12))):
        place = start + k * spacing * direction + rng.normal(0, 1.0, 2)
        cv2.circle(image, _ints(place), int(rng.integers(2, 5)), 1, -1)


def _rubble(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """A breakwater of rocks along a bent line, and single rocks."""
    size = image.shape[0]
    ends = rng.uniform(0.1, 0.9, (3, 2)) * size
    for t in np.linspace(0, 1, 60):
        middle = (1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * ends[1] + t**2 * ends[2]
        cv2.circle(image, _ints(middle + rng.normal(0, 5, 2)), int(rng.integers(3, 9)), 1, -1)
    for _ in range(int(rng.integers(5, 25))):
        cv2.circle(image, _ints(rng.uniform(0, size, 2)), int(rng.integers(2, 12)), 1, -1)


def _smooth_noise(size: int, scale: float, rng: np.random.Generator) -> NDArray[np.float32]:
    noise = rng.standard_normal((size, size)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), scale, borderType=cv2.BORDER_REFLECT)
    return noise / np.float32(noise.std())


def _lake(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    field = _smooth_noise(size, size * rng.uniform(0.05, 0.09), rng)
    field += np.float32(0.35) * _smooth_noise(size, size * 0.018, rng)
    image = (field > rng.uniform(0.6, 1.1)).astype(np.uint8)
    for _ in range(int(rng.integers(10, 40))):
        axes = tuple(int(v) for v in rng.integers(2, 10, 2))
        center = _ints(rng.uniform(0, size, 2))
        cv2.ellipse(image, center, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    return image


def _cave(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    field = _smooth_noise(size, rng.uniform(14, 24), rng)
    field += np.float32(0.25) * _smooth_noise(size, 5.0, rng)
    return (field > rng.uniform(-0.1, 0.3)).astype(np.uint8)


def _symmetric(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A place that looks the same after a half turn."""
    makers = (_office, _harbour, _cave)
    half = makers[int(rng.integers(len(makers)))](size, rng)
    image = half.copy()
    image[size - size // 2 :] = np.rot90(half, 2)[size - size // 2 :]
    return image


def _basin(size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A plain basin along x with a few piers, the same after a half turn."""
    image = np.ones((size, size), np.uint8)
    margin = int(BASIN_MARGIN * size)
    width = int(size * rng.uniform(0.2, 0.5))
    top = (size - width) // 2
    image[top : top + width, margin : size - margin] = 0
    corner = int(rng.choice([0, 0, width // 6, width // 2 - 1]))
    if corner:
        image[top : top + width, margin : margin + corner] = 1
        center = (margin + corner, top + width // 2)
        axes = (corner, width // 2)
        if rng.random() < 0.5:
            cv2.ellipse(image, center, axes, 0.0, 90.0, 270.0, 0, -1)
        else:
            corners = [(center[0], top), (margin, center[1]), (center[0], top + width)]
            cv2.fillPoly(image, [np.array(corners, np.int32)], 0)
    for _ in range(int(rng.integers(0, 4))):
        x, length = int(rng.uniform(margin, size // 2)), int(width * rng.uniform(0.1, 0.4))
        start = top if rng.random() < 0.5 else top + width - length
        image[start : start + length, x : x + int(rng.integers(4, 20))] = 1
    whole = image.copy()
    whole[:, size - size // 2 :] = np.rot90(image, 2)[:, size - size // 2 :]
    return whole
