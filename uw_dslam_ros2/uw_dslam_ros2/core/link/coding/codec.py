"""A submap in layers, each of which says more: outline, cells of 0.3 m, walls of 0.1 m.

Every layer decodes with those before it, and with nothing else. The receiver's submap is an
ordinary one whose cells are those of the finest layer that it has, so that whoever has the same
layers has the same submap, the sender too.
"""

from __future__ import annotations

import dataclasses
import enum
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
    levelled,
    occupancy_of,
    reduce_cells,
    seen_free,
    with_walls,
)
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter, digest_of
from uw_dslam_ros2.core.link.coding.outline import Outline, shape_of_cells
from uw_dslam_ros2.core.link.coding.path import read_path, write_path
from uw_dslam_ros2.core.submap import Submap

__all__ = [
    "CODEC_VERSION",
    "CellLayer",
    "Layer",
    "LayeredSubmap",
    "encode_submap",
    "read_outline",
    "write_outline",
]

CODEC_VERSION = 3
"""Of layers; others are refused."""
_UNIT_M = 1e-4  # of cell sizes
_CORNER_M = 1e-3
_MAX_SIDE = 2000
_MAX_CORNER = 1_000_000_000  # [mm]
_TAG_BYTES = 4
_SMALL_UNITS = 1000  # 0.1 m
# Cells of 0.3 and 0.1 m; of larger cells than 0.1 m the same multiples.
_FACTORS = {1: 3, 2: 1}
_BLOCK = 2
"""Cells of 0.3 m a side of the blocks in which free water is told: its border costs most and tells
the registration least."""


class Layer(enum.IntEnum):
    """What is sent of a submap, in this order."""

    OUTLINE = 0
    COARSE = 1
    """Walls in cells of 0.3 m, what is free in blocks of 0.6 m, and the path."""
    FINE = 2
    """Where the walls are in cells of 0.1 m; what is free is told no better than before."""

    @classmethod
    def numbered(cls, number: int) -> Layer:
        """The layer of a number; `InvalidInputError` where there is none."""
        if number not in list(cls):
            raise InvalidInputError(f"number of the layer is {number}, expected 0 to {max(cls)}")
        return cls(number)


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
        return self.unit * _FACTORS[self.layer] * _UNIT_M


class LayeredSubmap:
    """What was received of one submap: layers in, an ordinary `Submap` out.

    Parameters
    ----------
    key
        Of the fleet's checksums; empty: they only tell errors.
    """

    def __init__(self, key: bytes = b"") -> None:
        self._key = key
        self.outline: Outline | None = None
        self.cells: CellLayer | None = None

    def add(self, data: bytes) -> Layer:
        """Take a layer and say which it was; an older outline or a coarser layer does nothing.

        Raises
        ------
        InvalidInputError
            What is wrong with it; nothing has changed then.
        """
        layer, reader = _head(data)
        if layer is Layer.OUTLINE:
            outline = read_outline(data, self._key)
            if self.outline is None or outline.revision > self.outline.revision:
                self.outline = outline
            return layer
        if layer is Layer.COARSE:
            found = _read_coarse(reader, self._key)
            if self.cells is None or self.cells.tag != found.tag:
                self.cells = found
            return layer
        if self.cells is None or self.cells.layer is not Layer.COARSE:
            held = "none" if self.cells is None else self.cells.layer.name
            raise InvalidInputError(f"layer {layer.name} builds on {held}, expected COARSE")
        self.cells = _read_fine(reader, self.cells, self._key)
        return layer

    @property
    def revision(self) -> int | None:
        """Of `submap`: grows with the outline's and with each finer layer; None without one."""
        if self.outline is None or self.cells is None or self.cells.first_tag != self.outline.tag:
            return None
        return 4 * self.outline.revision + int(self.cells.layer)

    def submap(self, vehicle_id: str) -> Submap | None:
        """The submap as the layers have it; None before the outline and the cells it names."""
        outline, cells, revision = self.outline, self.cells, self.revision
        if outline is None or cells is None or revision is None:
            return None
        return Submap(
            vehicle_id,
            outline.sequence,
            revision,
            outline.is_final,
            int(cells.stamps_ns[-1]) if len(cells.stamps_ns) else 0,
            outline.T_odom_submap,
            outline.covariance,
            occupancy_of(
                cells.cells,
                cells.resolution_m,
                cells.corner[0] * _CORNER_M,
                cells.corner[1] * _CORNER_M,
            ),
            trajectory=cells.trajectory,
            trajectory_stamp_ns=cells.stamps_ns,
            run_id=outline.run_id,
        )


def encode_submap(
    submap: Submap, key: bytes = b"", finest: Layer = Layer.FINE
) -> dict[Layer, bytes]:
    """Layers of a submap, down to `finest`.

    Parameters
    ----------
    submap
        With at most `_MAX_SIDE` cells of 0.1 m a side, or of its own size where that is larger.
    key
        Of the fleet's checksums.
    finest
        At least `Layer.COARSE`.
    """
    occupancy = levelled(submap.grid, _UNIT_M)
    own_units = round(occupancy.spec.resolution_m / _UNIT_M)
    small = max(1, round(_SMALL_UNITS / own_units))
    corner = tuple(round(v / _CORNER_M) for v in occupancy.spec.T_frame_grid.as_array()[:2])
    reduced, (row, col) = _reduced(occupancy.values, small, finest)
    unit = own_units * small
    corner = (corner[0] + col * unit // 10, corner[1] + row * unit // 10)
    coarse_data, coarse = _write_coarse(submap, unit, corner, reduced[Layer.COARSE], key)
    layers = {Layer.COARSE: coarse_data}
    if finest is Layer.FINE:
        layers[Layer.FINE] = _write_fine(coarse, reduced[Layer.FINE], key)
    reach, histogram, length_m = shape_of_cells(
        coarse.cells, coarse.resolution_m, (corner[0] * _CORNER_M, corner[1] * _CORNER_M)
    )
    outline = Outline(
        submap.run_id,
        submap.sequence,
        submap.revision,
        submap.is_final,
        submap.T_odom_submap,
        np.asarray(submap.covariance, dtype=np.float64),
        reach,
        histogram,
        length_m,
        coarse.tag,
    )
    return {Layer.OUTLINE: write_outline(outline, key), **layers}


def write_outline(outline: Outline, key: bytes = b"") -> bytes:
    """The layer of an outline."""
    writer = _begun(Layer.OUTLINE)
    outline.write(writer)
    return bytes(writer) + digest_of(bytes(writer), key)


def read_outline(data: bytes, key: bytes = b"") -> Outline:
    """Undo `write_outline`."""
    layer, reader = _head(data[:-_TAG_BYTES])
    if layer is not Layer.OUTLINE or digest_of(data[:-_TAG_BYTES], key) != data[-_TAG_BYTES:]:
        raise InvalidInputError(f"{layer.name} of {len(data)} bytes, expected a sound outline")
    outline = Outline.read(reader)
    if reader.rest:
        raise InvalidInputError(f"{len(reader.rest)} bytes follow the outline, expected none")
    return outline


def layer_of(data: bytes) -> Layer:
    """Which layer some bytes say that they are."""
    return _head(data)[0]


def _begun(layer: Layer) -> ByteWriter:
    writer = ByteWriter()
    writer.fixed(CODEC_VERSION << 2 | layer, 1)
    return writer


def _head(data: bytes) -> tuple[Layer, ByteReader]:
    reader = ByteReader(data)
    head = reader.fixed(1)
    if head >> 2 != CODEC_VERSION:
        raise InvalidInputError(f"version of the codec is {head >> 2}, expected {CODEC_VERSION}")
    return Layer.numbered(head & 3), reader


def _reduced(
    values: NDArray[np.int8], small: int, finest: Layer
) -> tuple[dict[Layer, CellArray], tuple[int, int]]:
    """Cells of each layer down to `finest`, cut to what is known, and its first row and column.

    The window is whole blocks; first row and column are counted in cells of the finest layer.
    """
    values = np.ascontiguousarray(values)
    cells = {
        Layer(number): reduce_cells(values, small, factor)
        for number, factor in _FACTORS.items()
        if number <= finest
    }
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


def _write_coarse(
    submap: Submap, unit: int, corner: tuple[int, int], cells: CellArray, key: bytes
) -> tuple[bytes, CellLayer]:
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
    is_open = near_cells(free > 0)
    walls = (cells == CELL_WALL) & is_open
    found = _tagged(head, unit, corner, _with_marked(free, walls), path, key)
    blocks = encode_marks(is_known, np.zeros(is_known.shape, np.int8))
    writer = _begun(Layer.COARSE)
    writer.raw(found.tag + head)
    writer.varint(len(blocks))
    writer.raw(blocks + encode_marks(walls, free, is_open))
    return bytes(writer), found


def _free_cells(is_known: NDArray[np.bool_]) -> CellArray:
    """Free where a block is known, unknown elsewhere."""
    cells = is_known.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)
    return np.where(cells, np.int8(CELL_FREE), np.int8(0))


def _with_marked(free: CellArray, walls: NDArray[np.bool_]) -> CellArray:
    cells = seen_free((free > 0) & ~walls).astype(np.int8) * np.int8(CELL_FREE)
    cells[walls] = CELL_WALL
    return cells


def _read_coarse(reader: ByteReader, key: bytes) -> CellLayer:
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
    walls = decode_marks(reader.rest, free, near_cells(free > 0))
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


def _write_fine(below: CellLayer, cells: CellArray, key: bytes) -> bytes:
    known = _known_of_fine(below)
    is_open = near_cells(known == CELL_WALL)
    walls = (cells == CELL_WALL) & is_open
    found = _refined(below, with_walls(known, walls), key)
    writer = _begun(Layer.FINE)
    writer.raw(found.tag + encode_marks(walls, known, is_open))
    return bytes(writer)


def _read_fine(reader: ByteReader, below: CellLayer, key: bytes) -> CellLayer:
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
