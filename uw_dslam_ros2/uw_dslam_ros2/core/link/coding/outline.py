"""The first layer: what is enough to tell with whom a submap is worth matching."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.link.coding.cell_coder import CELL_UNKNOWN, CELL_WALL, CellArray
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["NUM_BINS", "Outline", "shape_of_cells"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NUM_BINS = 20
"""Bins of the distances between walls."""
_DIRECTIONS = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]])
_REACH_STEP_M = 0.5
_MAX_WALLS = 200
_TAG_BYTES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """What a vehicle says of a submap before, or instead of, its cells.

    ``reach_m`` (8,) are the distances from the submap's origin to the lines around all that is
    known, in steps of 45 degrees from +x. ``histogram`` (20,) are shares of distances between
    walls in fifteenths of the largest one, ``wall_length_m`` about how long the walls are.
    ``tag`` names the cells that belong to it.
    """

    run_id: int
    sequence: int
    revision: int
    is_final: bool
    T_odom_submap: SE2
    covariance: FloatArray
    reach_m: FloatArray
    histogram: IntArray
    wall_length_m: float
    tag: bytes

    def write(self, writer: ByteWriter) -> None:
        """Append it."""
        writer.fixed(self.run_id, 4)
        writer.varint(2 * self.sequence + self.is_final)
        writer.varint(self.revision)
        writer.pose(self.T_odom_submap)
        writer.covariance(self.covariance)
        for reach in self.reach_m:
            writer.fixed(min(255, max(0, math.ceil(reach / _REACH_STEP_M) + 128)), 1)
        for pair in self.histogram.reshape(-1, 2).tolist():
            writer.fixed(16 * pair[0] + pair[1], 1)
        writer.fixed(min(65535, math.ceil(self.wall_length_m)), 2)
        writer.raw(self.tag)

    @classmethod
    def read(cls, reader: ByteReader) -> Outline:
        """Take one."""
        run_id, sequence = reader.fixed(4), reader.varint()
        revision, T_odom_submap = reader.varint(), reader.pose()
        covariance = reader.covariance()
        reach = np.array([(reader.fixed(1) - 128) * _REACH_STEP_M for _ in range(8)])
        pairs = [divmod(reader.fixed(1), 16) for _ in range(NUM_BINS // 2)]
        return cls(
            run_id,
            sequence // 2,
            revision,
            bool(sequence % 2),
            T_odom_submap,
            covariance,
            reach,
            np.array(pairs, np.int64).ravel(),
            float(reader.fixed(2)),
            reader.raw(_TAG_BYTES),
        )

    def likeness(self, other: Outline) -> float:
        """How much the walls of both could have in common [m]: the larger, the sooner to match."""
        mine, theirs = self.histogram.sum(), other.histogram.sum()
        if mine == 0 or theirs == 0:
            return 0.0
        common = np.minimum(self.histogram / mine, other.histogram / theirs).sum()
        return float(common) * min(self.wall_length_m, other.wall_length_m)


def shape_of_cells(
    cells: CellArray, resolution_m: float, corner: tuple[float, float]
) -> tuple[FloatArray, IntArray, float]:
    """`Outline`'s reach, histogram and length of walls of cells with that outer corner [m]."""
    known = np.argwhere(cells != CELL_UNKNOWN)
    reach = np.zeros(8)
    if len(known):
        points = (known[:, ::-1] + 0.5) * resolution_m + np.array(corner)
        unit = _DIRECTIONS / np.hypot(*_DIRECTIONS.T)[:, None]
        reach = (points @ unit.T).max(axis=0) + resolution_m
    walls = np.argwhere(cells == CELL_WALL)
    length_m = len(walls) * resolution_m
    walls = walls[:: max(1, -(-len(walls) // _MAX_WALLS))]
    if len(walls) < 2:
        return reach, np.zeros(NUM_BINS, np.int64), length_m
    first, second = np.triu_indices(len(walls), k=1)
    distance = np.hypot(*(walls[first] - walls[second]).T.astype(np.float64)) * resolution_m
    # Bins that widen by a quarter: half a metre to fifty.
    index = np.floor(10.0 * np.log10(np.maximum(distance, 0.5) / 0.5)).astype(int)
    counts = np.bincount(np.minimum(index, NUM_BINS - 1), minlength=NUM_BINS)
    return reach, np.rint(15.0 * counts / counts.max()).astype(np.int64), length_m
