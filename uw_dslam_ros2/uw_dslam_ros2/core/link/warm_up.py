"""Compiles the kernels of the link."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.link.coding.cell_coder import decode_marks, encode_marks
from uw_dslam_ros2.core.link.coding.cells import reduce_cells

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel on tiny input."""
    cells = reduce_cells(np.full((6, 6), 100, np.int8), 1, [1])[1]
    unknown = np.zeros_like(cells)
    decode_marks(encode_marks(cells > 0, unknown), unknown)
