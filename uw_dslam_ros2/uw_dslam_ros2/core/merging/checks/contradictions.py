"""What maps say against each other: walls of one vehicle in the free water of others."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.config import VAGUE_CELLS
from uw_dslam_ros2.core.merging.graph.components import Component
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Contradiction", "contradicting_map"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_CELL_M = 0.5
"""Walls are compared in such cells and their neighbours, or in larger ones where the submaps' own
are coarse: poses are held to `VAGUE_CELLS` of those.
"""
_WALL_PERCENT, _FREE_PERCENT = 50, 25
_MIN_WALLS = 8
"""Cells of wall that others must have seen of a submap, for a judgement."""
_CONTRADICTED = 0.5
"""Share of them in others' free water: up to 0.4 in maps that are right, 0.6 and more else."""
_MIN_SUBMAPS = 3
_MIN_SHARE = 1.0 / 3.0
_MIN_TRACKS = 3


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How many of a run's submaps contradict the maps of the others, of how many judged."""

    track: Track
    num: int
    num_judged: int

    @property
    def share(self) -> float:
        """Of those judged."""
        return self.num / self.num_judged


@dataclass(frozen=True, slots=True, eq=False)
class _Sketch:
    """A submap in coarse cells."""

    walls: FloatArray
    """(K, 2) [m] in the submap's frame."""
    near_wall: BoolArray
    free: BoolArray
    T_submap_cells: SE2
    cell_m: float


def contradicting_map(
    submaps: Mapping[SubmapId, StoredSubmap], components: Sequence[Component], memory: Memory
) -> Contradiction | None:
    """The run whose submaps lie where others have seen something else, if there is one.

    Each cell of a wall is put to those other runs that have seen its place: a wall there, or free
    water. A run of which at least three submaps, and a third of all that can be judged, have most
    of their walls in free water is not where the graph has put it. Of two runs that are blamed
    alike nobody knows which one is wrong: two say nothing about each other, and of equal ones none
    is named.

    Parameters
    ----------
    submaps
        Those that are drawn.
    components
        Their poses.
    memory
        Of what was worked out before.
    """
    blamed: list[Contradiction] = []
    for component in components:
        poses = {i: component[i] for i in component if i in submaps}
        if len({i.track for i in poses}) < _MIN_TRACKS:
            continue
        key = ("contradictions", _digest(submaps, poses))
        blamed += memory.remember(key, partial(_counted, submaps, poses, memory))
    worst = [one for one in blamed if one.share == max(other.share for other in blamed)]
    return worst[0] if len(worst) == 1 else None


def _digest(submaps: Mapping[SubmapId, StoredSubmap], poses: Mapping[SubmapId, SE2]) -> bytes:
    hasher = hashlib.blake2b(digest_size=16)
    for submap_id, motion in sorted(poses.items()):
        hasher.update(submap_id.stable_name.encode() + submaps[submap_id].digest)
        hasher.update(motion.as_array().tobytes())
    return hasher.digest()


def _counted(
    submaps: Mapping[SubmapId, StoredSubmap], poses: Mapping[SubmapId, SE2], memory: Memory
) -> list[Contradiction]:
    """Runs with too many submaps that contradict others."""
    ids = sorted(poses)
    sketches = {
        i: memory.remember(("sketch", submaps[i].digest), partial(_sketch, submaps[i]))
        for i in ids
    }
    centers = np.array([poses[i].as_array()[:2] for i in ids])
    radii = np.array([submaps[i].radius_m for i in ids])
    counts: dict[Track, list[bool]] = {}
    for index, submap_id in enumerate(ids):
        reach = radii + radii[index]
        near = np.flatnonzero(np.hypot(*(centers - centers[index]).T) <= reach)
        others = [ids[k] for k in near if ids[k].track != submap_id.track]
        share = _contradicted_share(submap_id, others, poses, sketches)
        if share is not None:
            counts.setdefault(submap_id.track, []).append(share >= _CONTRADICTED)
    found = [Contradiction(track, sum(own), len(own)) for track, own in sorted(counts.items())]
    return [one for one in found if one.num >= _MIN_SUBMAPS and one.share >= _MIN_SHARE]


def _contradicted_share(
    submap_id: SubmapId,
    others: Sequence[SubmapId],
    poses: Mapping[SubmapId, SE2],
    sketches: Mapping[SubmapId, _Sketch],
) -> float | None:
    """Share of a submap's walls that most other runs see as free; None: too few are seen."""
    walls = poses[submap_id].apply(sketches[submap_id].walls)
    if len(walls) < _MIN_WALLS:
        return None
    says_wall: dict[Track, BoolArray] = {}
    says_free: dict[Track, BoolArray] = {}
    for other in others:
        sketch = sketches[other]
        T_cells_map = (poses[other] @ sketch.T_submap_cells).inverse()
        cells = np.floor(T_cells_map.apply(walls)[:, ::-1] / sketch.cell_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < sketch.free.shape)).all(axis=1)
        rows, cols = cells[inside].T
        for said, layer in ((says_wall, sketch.near_wall), (says_free, sketch.free)):
            votes = said.setdefault(other.track, np.zeros(len(walls), np.bool_))
            votes[inside] |= layer[rows, cols]
    num_wall, num_free = np.zeros(len(walls), np.int64), np.zeros(len(walls), np.int64)
    for track, votes in says_wall.items():
        num_wall += votes
        num_free += says_free[track] & ~votes
    is_judged = num_wall + num_free > 0
    if np.count_nonzero(is_judged) < _MIN_WALLS:
        return None
    return float((num_free > num_wall)[is_judged].mean())


def _sketch(stored: StoredSubmap) -> _Sketch:
    import cv2  # large, so loaded when first used

    spec, values = stored.submap.grid.spec, stored.submap.grid.values
    step = math.ceil(max(_CELL_M / spec.resolution_m - 0.5, VAGUE_CELLS))
    rows, cols = -(-spec.num_rows // step), -(-spec.num_cols // step)
    padded = np.full((rows * step, cols * step), -1, np.int8)
    padded[: spec.num_rows, : spec.num_cols] = values
    blocks = padded.reshape(rows, step, cols, step)
    has_wall = (blocks > _WALL_PERCENT).any(axis=(1, 3))
    is_free = ((blocks >= 0) & (blocks < _FREE_PERCENT)).mean(axis=(1, 3)) > 0.5
    near_wall = cv2.dilate(has_wall.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    cell_m = step * spec.resolution_m
    walls = spec.T_frame_grid.apply((np.argwhere(has_wall)[:, ::-1] + 0.5) * cell_m)
    return _Sketch(walls, near_wall, is_free & ~near_wall, spec.T_frame_grid, cell_m)
