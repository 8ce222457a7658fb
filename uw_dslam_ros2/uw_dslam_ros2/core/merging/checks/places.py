"""Where two maps meet, and where asking again would tell most."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import compose_covariances
from uw_dslam_ros2.core.se2 import SE2, compose_poses, invert_poses
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Ends", "meetings", "pose_uncertainty", "sigma_m", "vague_places"]

FloatArray = NDArray[np.float64]
Ends = tuple[SubmapId, SubmapId]
"""Source and target."""

_MIN_SHARE = 0.25
"""Least common area of two submaps, as a share of the smaller, that is worth a check."""
_FULL_SHARE = 0.4
"""The same for a further constraint: who shares less must be as much vaguer to be worth one."""
_ROUNDING_M = 1e-6
_BLOCK = 256
"""Circles that are compared with all others at a time."""


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
    own, others = _Circles(library, source), _Circles(library, target)
    for i, j in own.touching(others, T_target_source):
        source_id, target_id = own.ids[i], others.ids[j]
        T_between = target.T_frame_submap[target_id].inverse() @ (
            T_target_source @ source.T_frame_submap[source_id]
        )
        share = _share(library, source_id, target_id, T_between)
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
    sharing: dict[Ends, float] = {}
    circles = _Circles(library, side)
    for i, j in circles.touching(circles):
        target_id, source_id = circles.ids[i], circles.ids[j]
        if source_id <= target_id:
            continue
        if chosen is not None and target_id not in chosen and source_id not in chosen:
            continue
        if not _is_apart(source_id, target_id, 2 * num_neighbours + 1):
            continue
        share = _share(library, source_id, target_id, side.between(target_id, source_id))
        if share >= _MIN_SHARE:
            sharing[source_id, target_id] = share
    pairs = [*sharing]
    cells_m = [
        library.submaps[ends[1]].submap.grid.spec.resolution_m
        * max(1.0, _FULL_SHARE / sharing[ends])
        for ends in pairs
    ]
    candidates = [
        (sharing[ends] * sigma, *ends, uncertainty)
        for ends, uncertainty, sigma in _vague(pairs, vague_cells * np.array(cells_m), side, edges)
    ]
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
    return _uncertainties([main], [ends], source, target)[0]


def _uncertainties(
    mains: Sequence[Edge], ends: Sequence[Ends], source: Side, target: Side
) -> FloatArray:
    """Covariances (N, 3, 3) of where one submap lies in another, over one edge each."""
    motion = _stacked(main.T_target_source for main in mains)
    T_target = compose_poses(
        invert_poses(_stacked(target.T_frame_submap[end] for _, end in ends)),
        _stacked(target.T_frame_submap[main.target] for main in mains),
    )
    T_source = compose_poses(
        invert_poses(_stacked(source.T_frame_submap[main.source] for main in mains)),
        _stacked(source.T_frame_submap[end] for end, _ in ends),
    )
    pairs = list(zip(mains, ends, strict=True))
    by_target = np.array([target.covariance(end, main.target) for main, (_, end) in pairs])
    by_source = np.array([source.covariance(main.source, end) for main, (end, _) in pairs])
    none = np.zeros_like(motion)
    return (
        compose_covariances(by_target, none, T_target, compose_poses(motion, T_source))
        + compose_covariances(
            np.array([main.covariance for main in mains]), T_target, motion, T_source
        )
        + compose_covariances(by_source, compose_poses(T_target, motion), T_source, none)
    )


def _stacked(motions: Iterable[SE2]) -> FloatArray:
    return np.array([(motion.x, motion.y, motion.yaw) for motion in motions])


def sigma_m(covariance: FloatArray) -> float:
    """Largest standard deviation of the translation."""
    return float(_sigmas_m(covariance[None])[0])


def _sigmas_m(covariances: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(0.0, np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1]))


def _vague(
    pairs: Sequence[Ends], limits_m: FloatArray, side: Side, edges: Sequence[Edge]
) -> list[tuple[Ends, FloatArray, float]]:
    """Of pairs, those that neither odometry nor any single edge makes as sure as their limits.

    With each, the least covariance (3, 3), and the standard deviation [m] that it means.
    """
    by_tracks: dict[tuple[Track, Track], list[Edge]] = {}
    for edge in edges:
        tracks = edge.source.track, edge.target.track
        by_tracks.setdefault(tracks, []).append(edge)
        if tracks[0] != tracks[1]:
            by_tracks.setdefault(tracks[::-1], []).append(edge.reversed())
    members: dict[tuple[Track, Track], list[int]] = {}
    for index, (source_id, target_id) in enumerate(pairs):
        members.setdefault((source_id.track, target_id.track), []).append(index)
    found: list[tuple[Ends, FloatArray, float]] = []
    for tracks, indices in members.items():
        own, limits = [pairs[i] for i in indices], limits_m[indices]
        joining = by_tracks.get(tracks, [])
        if joining:
            # Most are sure enough over the edge that is the fewest steps away.
            steps = np.abs(_sequences(own)[:, None] - _sequences(_ends_of(joining))[None])
            nearest = [joining[i] for i in steps.sum(axis=2).argmin(axis=1)]
            is_vague = _sigmas_m(_uncertainties(nearest, own, side, side)) > limits
            own = [ends for ends, is_open in zip(own, is_vague, strict=True) if is_open]
            limits = limits[is_vague]
        for ends, limit_m in zip(own, limits.tolist(), strict=True):
            ways: list[FloatArray] = []
            if not joining or tracks[0] == tracks[1]:
                ways.append(side.covariance(ends[1], ends[0]))
            if joining:
                ways += [*_uncertainties(joining, [ends] * len(joining), side, side)]
            sigmas = _sigmas_m(np.array(ways))
            best = int(sigmas.argmin())
            if sigmas[best] > limit_m:
                found.append((ends, ways[best], float(sigmas[best])))
    return found


def _sequences(pairs: Sequence[Ends]) -> NDArray[np.int64]:
    return np.array([(source_id.sequence, target_id.sequence) for source_id, target_id in pairs])


def _ends_of(edges: Sequence[Edge]) -> list[Ends]:
    return [(edge.source, edge.target) for edge in edges]


class _Circles:
    """Around what each submap of a side has seen."""

    def __init__(self, library: Library, side: Side) -> None:
        self.ids = sorted(side.T_frame_submap)
        self._poses = _stacked(side.T_frame_submap[i] for i in self.ids).reshape(-1, 3)
        self._radius_m = np.array([library.submaps[i].radius_m for i in self.ids])

    def touching(self, others: _Circles, T_others_self: SE2 = SE2()) -> Iterator[tuple[int, int]]:
        """Numbers of circles, each with one of the others that it may touch; in order."""
        center = T_others_self.apply(self._poses[:, :2])
        for first in range(0, len(center), _BLOCK):
            block = slice(first, first + _BLOCK)
            away = center[block, None] - others._poses[None, :, :2]
            reach = self._radius_m[block, None] + (others._radius_m + _ROUNDING_M)
            near = np.hypot(away[..., 0], away[..., 1]) <= reach
            for i, j in np.argwhere(near).tolist():
                yield first + i, j


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
    # Asked of pairs by the million: making their tracks would take longer than the comparison.
    return one[:2] != other[:2] or abs(one.sequence - other.sequence) > num_neighbours
