"""The layers of a submap that hold cells: coarse ones with the path, and the walls' fine ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.cell_coder import (
    CELL_FREE,
    CELL_WALL,
    CellArray,
    decode_marks,
    encode_marks,
    near_cells,
)
from uw_dslam_ros2.core.link.coding.cells import (
    blocks_of_known,
    known_window,
    reduce_cells,
    seen_free,
    with_walls,
)
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter, digest_of
from uw_dslam_ros2.core.link.coding.layer import Layer, begun
from uw_dslam_ros2.core.link.coding.path import read_path, write_path
from uw_dslam_ros2.core.submap import Submap

__all__ = [
    "CORNER_M",
    "UNIT_M",
    "CellLayer",
    "read_coarse",
    "read_fine",
    "reduced_layers",
    "write_coarse",
    "write_fine",
]

CORNER_M = 1e-3
"""Of corners."""
UNIT_M = 1e-4
"""Of cell sizes."""
_MAX_SIDE = 2000
_MAX_CORNER = 1_000_000_000  # [mm]
_TAG_BYTES = 4
# Cells of 0.3 and 0.1 m; of larger cells than 0.1 m the same multiples.
_FACTORS = {1: 3, 2: 1}
_BLOCK = 2
"""Cells of 0.3 m a side of the blocks in which free water is told: its border costs most and tells
the registration least."""


@dataclass(frozen=True, slots=True, eq=False)
class CellLayer:
    """Decoded cells (R, C) of one layer, from a corner that all layers of a submap share.

    ``tag`` is the checksum of all that was decoded, and of the layer that it builds on;
    ``first_tag`` is that of the coarse layer, which the outline names.
    """

    layer: Layer
    unit: int  # cell size of the finest layer, in 0.1 mm
    corner: tuple[int, int]  # x, y of the outer corner in the submap's frame [mm]
    cells: CellArray
    stamps_ns: NDArray[np.int64]
    trajectory: NDArray[np.float64]
    tag: bytes
    first_tag: bytes

    @property
    def resolution_m(self) -> float:
        """Cell size."""
        return self.unit * _FACTORS[self.layer] * UNIT_M


def reduced_layers(
    values: NDArray[np.int8], small: int, finest: Layer
) -> tuple[dict[Layer, CellArray], tuple[int, int]]:
    """Cells of each layer down to `finest`, cut to what is known, and its first row and column.

    The window is whole blocks; first row and column are counted in cells of the finest layer.
    """
    factors = {Layer(n): factor for n, factor in _FACTORS.items() if n <= finest}
    reduced = reduce_cells(values, small, factors.values())
    cells = {layer: reduced[factor] for layer, factor in factors.items()}
    rows, cols = known_window(cells[Layer.COARSE])
    sides = [-(-max(1, window.stop - window.start) // _BLOCK) * _BLOCK for window in (rows, cols)]
    cut = {}
    for layer, whole in cells.items():
        times = _FACTORS[Layer.COARSE] // _FACTORS[layer]
        row_0, row_1, col_0, col_1 = (
            times * edge for edge in (rows.start, rows.stop, cols.start, cols.stop)
        )
        part = whole[row_0:row_1, col_0:col_1]
        cut[layer] = np.zeros((times * sides[0], times * sides[1]), np.int8)
        cut[layer][: part.shape[0], : part.shape[1]] = part
    fine = tuple(_FACTORS[Layer.COARSE] * side for side in cut[Layer.COARSE].shape)
    if max(fine) > _MAX_SIDE:
        raise InvalidInputError(
            f"the submap is {fine} cells of the finest layer, expected at most {_MAX_SIDE} a side"
        )
    return cut, (3 * rows.start, 3 * cols.start)


def write_coarse(
    submap: Submap, unit: int, corner: tuple[int, int], cells: CellArray, key: bytes
) -> tuple[bytes, CellLayer]:
    """The layer of coarse cells (R, C) and the path, and what a receiver has of it.

    Parameters
    ----------
    submap
        Whose path it is.
    unit
        Cell size of the finest layer [0.1 mm].
    corner
        x, y of the outer corner in the submap's frame [mm].
    cells
        As `reduced_layers` gives them.
    key
        Of the fleet's checksums.
    """
    body = ByteWriter()
    body.varint(unit)
    body.signed(corner[0])
    body.signed(corner[1])
    body.varint(cells.shape[0] // _BLOCK)
    body.varint(cells.shape[1] // _BLOCK)
    write_path(body, submap.trajectory_stamp_ns, submap.trajectory)
    head = bytes(body)
    path = read_path(_read_shape(head)[1])
    is_known = blocks_of_known(cells)
    free = _free_cells(is_known)
    walls = cells == CELL_WALL
    found = _tagged(head, unit, corner, _with_marked(free, walls), path, key)
    blocks = encode_marks(is_known, np.zeros(is_known.shape, np.int8))
    writer = begun(Layer.COARSE)
    writer.raw(found.tag + head)
    writer.varint(len(blocks))
    writer.raw(blocks + encode_marks(walls, free))
    return bytes(writer), found


def _free_cells(is_known: NDArray[np.bool_]) -> CellArray:
    """Free where a block is known, unknown elsewhere."""
    cells = is_known.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)
    return np.where(cells, np.int8(CELL_FREE), np.int8(0))


def _with_marked(free: CellArray, walls: NDArray[np.bool_]) -> CellArray:
    cells = seen_free((free > 0) & ~walls).astype(np.int8) * np.int8(CELL_FREE)
    cells[walls] = CELL_WALL
    return cells


def read_coarse(reader: ByteReader, key: bytes) -> CellLayer:
    """Undo `write_coarse`; `InvalidInputError` where the checksum or a number is not right."""
    tag = reader.raw(_TAG_BYTES)
    return _checked(_decoded_coarse(reader.rest, key), tag)


def _checked(found: CellLayer, tag: bytes) -> CellLayer:
    if found.tag != tag:
        raise InvalidInputError(
            f"checksum of the {found.layer.name} cells is {found.tag.hex()}, expected {tag.hex()}"
        )
    return found


def _decoded_coarse(body: bytes, key: bytes) -> CellLayer:
    (unit, corner, shape), reader = _read_shape(body)
    path = read_path(reader)
    head = body[: len(body) - len(reader.rest)]
    blocks = reader.raw(reader.varint())
    unknown = np.zeros((shape[0] // _BLOCK, shape[1] // _BLOCK), np.int8)
    free = _free_cells(decode_marks(blocks, unknown))
    walls = decode_marks(reader.rest, free)
    return _tagged(head, unit, corner, _with_marked(free, walls), path, key)


def _read_shape(body: bytes) -> tuple[tuple[int, tuple[int, int], tuple[int, int]], ByteReader]:
    """Cell size, corner, rows and columns; and what follows."""
    reader = ByteReader(body)
    unit = reader.bounded("the size of cells [0.1 mm]", 1, 1_000_000)
    corner = reader.signed(), reader.signed()
    shape = (
        _BLOCK * reader.bounded("the number of rows of blocks", 1, _MAX_SIDE // 6),
        _BLOCK * reader.bounded("the number of columns of blocks", 1, _MAX_SIDE // 6),
    )
    if max(abs(value) for value in corner) > _MAX_CORNER:
        raise InvalidInputError(f"the corner is {corner} mm, expected within {_MAX_CORNER}")
    return (unit, corner, shape), reader


def _tagged(
    head: bytes,
    unit: int,
    corner: tuple[int, int],
    cells: CellArray,
    path: tuple[NDArray[np.int64], NDArray[np.float64]],
    key: bytes,
) -> CellLayer:
    tag = digest_of(head + path[1].tobytes() + cells.tobytes(), key)
    return CellLayer(Layer.COARSE, unit, corner, cells, *path, tag, tag)


def write_fine(below: CellLayer, cells: CellArray, key: bytes) -> bytes:
    """The layer of fine cells (3 R, 3 C), for a receiver that has the coarse one."""
    known = _known_of_fine(below)
    is_open = near_cells(known == CELL_WALL)
    walls = (cells == CELL_WALL) & is_open
    found = _refined(below, with_walls(known, walls), key)
    writer = begun(Layer.FINE)
    writer.raw(found.tag + encode_marks(walls, known, is_open))
    return bytes(writer)


def read_fine(reader: ByteReader, below: CellLayer, key: bytes) -> CellLayer:
    """Undo `write_fine`; `InvalidInputError` where the checksum is not right."""
    tag = reader.raw(_TAG_BYTES)
    known = _known_of_fine(below)
    walls = decode_marks(reader.rest, known, near_cells(known == CELL_WALL))
    return _checked(_refined(below, with_walls(known, walls), key), tag)


def _known_of_fine(below: CellLayer) -> CellArray:
    """What the coarse layer says of each cell of the fine one."""
    factor = _FACTORS[Layer.COARSE] // _FACTORS[Layer.FINE]
    return np.ascontiguousarray(below.cells.repeat(factor, axis=0).repeat(factor, axis=1))


def _refined(below: CellLayer, cells: CellArray, key: bytes) -> CellLayer:
    tag = digest_of(below.tag + cells.tobytes(), key)
    return dataclasses.replace(below, layer=Layer.FINE, cells=cells, tag=tag)
