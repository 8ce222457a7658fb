"""A submap in layers, each of which says more: outline, cells of 0.3 m, walls of 0.1 m.

Every layer decodes with those before it, and with nothing else. The receiver's submap is an
ordinary one whose cells are those of the finest layer that it has, so that whoever has the same
layers has the same submap, the sender too.
"""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.cell_layers import (
    CORNER_M,
    UNIT_M,
    CellLayer,
    read_coarse,
    read_fine,
    reduced_layers,
    write_coarse,
    write_fine,
)
from uw_dslam_ros2.core.link.coding.cells import levelled, occupancy_of
from uw_dslam_ros2.core.link.coding.fields import digest_of
from uw_dslam_ros2.core.link.coding.layer import CODEC_VERSION, Layer, begun, head_of
from uw_dslam_ros2.core.link.coding.outline import Outline, shape_of_cells
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

_TAG_BYTES = 4
_SMALL_UNITS = 1000  # 0.1 m


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
        layer, reader = head_of(data)
        if layer is Layer.OUTLINE:
            outline = read_outline(data, self._key)
            if self.outline is None or outline.revision > self.outline.revision:
                self.outline = outline
            return layer
        if layer is Layer.COARSE:
            found = read_coarse(reader, self._key)
            if self.cells is None or self.cells.tag != found.tag:
                self.cells = found
            return layer
        if self.cells is None or self.cells.layer is not Layer.COARSE:
            held = "none" if self.cells is None else self.cells.layer.name
            raise InvalidInputError(f"layer {layer.name} builds on {held}, expected COARSE")
        self.cells = read_fine(reader, self.cells, self._key)
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
                cells.corner[0] * CORNER_M,
                cells.corner[1] * CORNER_M,
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
        With at most 2000 cells of 0.1 m a side, or of its own size where that is larger.
    key
        Of the fleet's checksums.
    finest
        At least `Layer.COARSE`.
    """
    occupancy = levelled(submap.grid, UNIT_M)
    own_units = round(occupancy.spec.resolution_m / UNIT_M)
    small = max(1, round(_SMALL_UNITS / own_units))
    corner = tuple(round(v / CORNER_M) for v in occupancy.spec.T_frame_grid.as_array()[:2])
    reduced, (row, col) = reduced_layers(occupancy.values, small, finest)
    unit = own_units * small
    corner = (corner[0] + col * unit // 10, corner[1] + row * unit // 10)
    coarse_data, coarse = write_coarse(submap, unit, corner, reduced[Layer.COARSE], key)
    layers = {Layer.COARSE: coarse_data}
    if finest is Layer.FINE:
        layers[Layer.FINE] = write_fine(coarse, reduced[Layer.FINE], key)
    reach, histogram, length_m = shape_of_cells(
        coarse.cells, coarse.resolution_m, (corner[0] * CORNER_M, corner[1] * CORNER_M)
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
    writer = begun(Layer.OUTLINE)
    outline.write(writer)
    return bytes(writer) + digest_of(bytes(writer), key)


def read_outline(data: bytes, key: bytes = b"") -> Outline:
    """Undo `write_outline`."""
    layer, reader = head_of(data[:-_TAG_BYTES])
    if layer is not Layer.OUTLINE or digest_of(data[:-_TAG_BYTES], key) != data[-_TAG_BYTES:]:
        raise InvalidInputError(f"{layer.name} of {len(data)} bytes, expected a sound outline")
    outline = Outline.read(reader)
    if reader.rest:
        raise InvalidInputError(f"{len(reader.rest)} bytes follow the outline, expected none")
    return outline
