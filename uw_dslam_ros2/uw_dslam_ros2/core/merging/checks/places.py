"""Where two maps meet, and where asking again would tell most."""

from __future__ import annotations

import itertools
import math
from collections.abc import Container, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import compose_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Ends", "meetings", "pose_uncertainty", "sigma_m", "vague_places"]

FloatArray = NDArray[np.float64]
Ends = tuple[SubmapId, SubmapId]
"""Source and target."""

_MIN_SHARE = 0.25
"""Least common area of two submaps, as a share of the smaller, that is worth a check."""
_MIN_VAGUE_SHARE = 0.4
"""The same for a further constraint, which nothing depends on."""


def meetings(
    library: Library,
    T_target_source: SE2,
    source: Side,
    target: Side,
    num_neighbours: int,
    limit: int,
) -> list[Ends]:
    """Pairs of submaps that share most if the sides lie so; first those away from each other."""
    shares: list[tuple[float, SubmapId, SubmapId]] = []
    for source_id, T_source in source.T_frame_submap.items():
        T_there = T_target_source @ T_source
        for target_id, T_target in target.T_frame_submap.items():
            share = _share(library, source_id, target_id, T_target.inverse() @ T_there)
            if share >= _MIN_SHARE:
                shares.append((share, source_id, target_id))
    shares.sort(key=lambda item: (-item[0], item[1], item[2]))
    pairs = [(source_id, target_id) for _, source_id, target_id in shares]
    return _spaced(pairs, num_neighbours, limit, fill=True)


def vague_places(
    library: Library,
    side: Side,
    edges: Sequence[Edge],
    num_neighbours: int,
    vague_cells: float,
    limit: int,
    chosen: Container[SubmapId] | None = None,
) -> list[tuple[Ends, FloatArray]]:
    """Pairs of places that saw the same but are unsure of each other, the vaguest first.

    Parameters
    ----------
    library
        All submaps.
    side
        Where they lie.
    edges
        What joins them besides odometry.
    num_neighbours
        That places are matched with.
    vague_cells
        Standard deviation [cells] from which on two places count as vague.
    limit
        At most so many pairs.
    chosen
        One of each pair must be among these; None: any pair.

    Returns
    -------
    list
        Source and target, and the covariance (3, 3) of where the one lies in the other.
    """
    candidates: list[tuple[float, SubmapId, SubmapId, FloatArray]] = []
    for target_id, source_id in itertools.combinations(sorted(side.T_frame_submap), 2):
        if chosen is not None and target_id not in chosen and source_id not in chosen:
            continue
        if not _is_apart(source_id, target_id, 2 * num_neighbours + 1):
            continue
        share = _share(library, source_id, target_id, side.between(target_id, source_id))
        if share < _MIN_VAGUE_SHARE:
            continue
        uncertainty = _known_best(source_id, target_id, side, edges)
        cell_m = library.submaps[target_id].submap.grid.spec.resolution_m
        if (sigma := sigma_m(uncertainty)) > vague_cells * cell_m:
            candidates.append((share * sigma, source_id, target_id, uncertainty))
    candidates.sort(key=lambda item: (-item[0], item[1], item[2]))
    found = {
        (source_id, target_id): covariance for _, source_id, target_id, covariance in candidates
    }
    return [(ends, found[ends]) for ends in _spaced([*found], num_neighbours, limit, fill=False)]


def pose_uncertainty(main: Edge | None, ends: Ends, source: Side, target: Side) -> FloatArray:
    """Covariance (3, 3) of where one submap lies in another of the other side.

    Over the edge `main`; without one, along both tracks from their beginnings.
    """
    if main is None:
        ways = [
            (side, min(side.T_frame_submap), end)
            for side, end in zip((source, target), ends, strict=True)
        ]
        return np.sum([side.covariance(end, start) for side, start, end in ways], axis=0)
    T_target = target.between(ends[1], main.target)
    T_source = source.between(main.source, ends[0])
    motion = main.T_target_source
    return (
        compose_covariance(
            target.covariance(ends[1], main.target), SE2(), T_target, motion @ T_source
        )
        + compose_covariance(main.covariance, T_target, motion, T_source)
        + compose_covariance(
            source.covariance(main.source, ends[0]), T_target @ motion, T_source, SE2()
        )
    )


def sigma_m(covariance: FloatArray) -> float:
    """Largest standard deviation of the translation."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))


def _known_best(
    source_id: SubmapId, target_id: SubmapId, side: Side, edges: Sequence[Edge]
) -> FloatArray:
    """Covariance (3, 3) of a relative pose along odometry, or over the best single edge."""
    ends = source_id, target_id
    known = [side.covariance(target_id, source_id)] if source_id.track == target_id.track else []
    for edge in edges:
        if (edge.source.track, edge.target.track) == (source_id.track, target_id.track):
            known.append(pose_uncertainty(edge, ends, side, side))
        elif (edge.target.track, edge.source.track) == (source_id.track, target_id.track):
            known.append(pose_uncertainty(edge.reversed(), ends, side, side))
    if not known:
        known = [side.covariance(target_id, source_id)]
    return min(known, key=sigma_m)


def _share(library: Library, source: SubmapId, target: SubmapId, T_target_source: SE2) -> float:
    """Area that both have seen over the smaller one's."""
    smaller = min(library.submaps[i].area_m2 for i in (source, target))
    return library.shared_area_m2(source, target, T_target_source) / smaller


def _spaced(pairs: Sequence[Ends], num_neighbours: int, limit: int, *, fill: bool) -> list[Ends]:
    """The first ones whose maps share no submap; to fill the limit, then the others."""
    reach = 2 * num_neighbours
    chosen: list[Ends] = []
    for pair in pairs:
        if len(chosen) >= limit:
            return chosen
        if all(_is_apart(pair[0], s, reach) or _is_apart(pair[1], t, reach) for s, t in chosen):
            chosen.append(pair)
    rest = [pair for pair in pairs if pair not in chosen] if fill else []
    return [*chosen, *rest][:limit]


def _is_apart(one: SubmapId, other: SubmapId, num_neighbours: int) -> bool:
    return one.track != other.track or abs(one.sequence - other.sequence) > num_neighbours
