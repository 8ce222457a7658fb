"""Where two maps meet, and where asking again would tell most."""

from __future__ import annotations

import itertools
from collections.abc import Container, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import compose_covariances
from uw_dslam_ros2.core.se2 import SE2, compose_poses, invert_poses
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Ends", "meetings", "pose_uncertainty", "sigma_m", "touching_tracks", "vague_places"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Ends = tuple[SubmapId, SubmapId]
"""Source and target."""

_MIN_SHARE = 0.25
"""Least common area of two submaps, as a share of the smaller, that is worth a check."""
_FULL_SHARE = 0.4
"""The same for a further constraint: who shares less must be as much vaguer to be worth one."""
_ROUNDING_M = 1e-6
_BLOCK, _BATCH = 256, 20_000
"""Circles that are compared with all others, and ways between places, at a time."""


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
    for i, j in zip(*own.touching(others, T_target_source), strict=True):
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
    circles = _Circles(library, side)
    first, second = circles.touching_each_other(chosen)
    is_asked = circles.are_apart(first, second, 2 * num_neighbours + 1)
    first, second = first[is_asked], second[is_asked]
    pairs = [(circles.ids[j], circles.ids[i]) for i, j in zip(first, second, strict=True)]
    limits_m = vague_cells * circles.cell_m[first]
    ties = _Ties(side, edges)
    # Most are sure enough over the edge that is the fewest steps away: what they share does not
    # matter then.
    is_open = ties.are_vague_over_nearest(pairs, limits_m)
    sharing: dict[Ends, float] = {}
    for index in np.flatnonzero(is_open).tolist():
        source_id, target_id = ends = pairs[index]
        share = _share(library, source_id, target_id, side.between(target_id, source_id))
        is_open[index] = share >= _MIN_SHARE
        sharing[ends] = share
    limits_m, pairs = limits_m[is_open], list(itertools.compress(pairs, is_open))
    surest = zip(pairs, limits_m.tolist(), *ties.surest(pairs), strict=True)
    candidates = [
        (sharing[ends] * sigma, *ends, covariance)
        for ends, limit_m, covariance, sigma in surest
        if sigma > limit_m * max(1.0, _FULL_SHARE / sharing[ends])
    ]
    candidates.sort(key=lambda item: (-item[0], item[1], item[2]))
    found = {
        (source_id, target_id): covariance for _, source_id, target_id, covariance in candidates
    }
    return [(ends, found[ends]) for ends in _spaced([*found], num_neighbours, limit, fill=False)]


def touching_tracks(library: Library, side: Side) -> set[frozenset[Track]]:
    """Pairs of tracks that may have seen the same somewhere."""
    circles = _Circles(library, side)
    first, second = circles.touching_each_other()
    is_between = circles.track[first] != circles.track[second]
    numbers = np.column_stack([circles.track[first], circles.track[second]])[is_between]
    return {
        frozenset((circles.tracks[a], circles.tracks[b]))
        for a, b in np.unique(numbers, axis=0).tolist()
    }


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
    by_target = target.covariances([end for _, end in ends], [main.target for main in mains])
    by_source = source.covariances([main.source for main in mains], [end for end, _ in ends])
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


class _Ties:
    """Edges within a side, by the two tracks that they join."""

    def __init__(self, side: Side, edges: Sequence[Edge]) -> None:
        self._side = side
        self._by_tracks: dict[tuple[Track, Track], list[Edge]] = {}
        for edge in edges:
            tracks = edge.source.track, edge.target.track
            self._by_tracks.setdefault(tracks, []).append(edge)
            if tracks[0] != tracks[1]:
                self._by_tracks.setdefault(tracks[::-1], []).append(edge.reversed())

    def are_vague_over_nearest(
        self, pairs: Sequence[Ends], limits_m: FloatArray
    ) -> NDArray[np.bool_]:
        """Whether pairs are less sure than limits (N,) over the edge that is nearest to each."""
        members: dict[tuple[Track, Track], list[int]] = {}
        for index, (source_id, target_id) in enumerate(pairs):
            members.setdefault((source_id.track, target_id.track), []).append(index)
        numbers: list[int] = []
        nearest: list[Edge] = []
        for tracks, indices in members.items():
            joining = self._by_tracks.get(tracks)
            if joining:
                own = _sequences([pairs[index] for index in indices])
                steps = np.abs(own[:, None] - _sequences(_ends_of(joining))[None])
                nearest += [joining[i] for i in steps.sum(axis=2).argmin(axis=1)]
                numbers += indices
        is_vague = np.ones(len(pairs), np.bool_)
        if nearest:
            ends = [pairs[number] for number in numbers]
            sigmas_m = _sigmas_m(_uncertainties(nearest, ends, self._side, self._side))
            is_vague[numbers] = sigmas_m > limits_m[numbers]
        return is_vague

    def surest(self, pairs: Sequence[Ends]) -> tuple[FloatArray, FloatArray]:
        """Least covariances (N, 3, 3) over odometry or single edges, and their deviations [m]."""
        found = np.zeros((len(pairs), 3, 3))
        sigmas_m = np.full(len(pairs), np.inf)

        def compare(numbers: Sequence[int], covariances: FloatArray) -> None:
            own = _sigmas_m(covariances)
            all_numbers = np.array(numbers)
            order = np.lexsort((np.arange(len(own)), own, all_numbers))
            number, first = np.unique(all_numbers[order], return_index=True)
            best = order[first]
            is_less = own[best] < sigmas_m[number]
            sigmas_m[number[is_less]] = own[best[is_less]]
            found[number[is_less]] = covariances[best[is_less]]

        joining = [self._by_tracks.get((s.track, t.track), []) for s, t in pairs]
        alone = [n for n, (s, t) in enumerate(pairs) if not joining[n] or s.track == t.track]
        if alone:
            sources, targets = zip(*(pairs[n] for n in alone), strict=True)
            compare(alone, self._side.covariances(targets, sources))
        ways = ((number, edge) for number, edges in enumerate(joining) for edge in edges)
        for batch in itertools.batched(ways, _BATCH):
            numbers, mains = zip(*batch, strict=True)
            ends = [pairs[number] for number in numbers]
            compare(numbers, _uncertainties(mains, ends, self._side, self._side))
        return found, sigmas_m


def _sequences(pairs: Sequence[Ends]) -> NDArray[np.int64]:
    return np.array([(source_id.sequence, target_id.sequence) for source_id, target_id in pairs])


def _ends_of(edges: Sequence[Edge]) -> list[Ends]:
    return [(edge.source, edge.target) for edge in edges]


class _Circles:
    """Around what each submap of a side has seen."""

    def __init__(self, library: Library, side: Side) -> None:
        self.ids = sorted(side.T_frame_submap)
        own = [library.submaps[i] for i in self.ids]
        self.cell_m = np.array([stored.submap.grid.spec.resolution_m for stored in own])
        self._center = _stacked(side.T_frame_submap[i] for i in self.ids).reshape(-1, 3)[:, :2]
        self._radius_m = np.array([stored.radius_m for stored in own])
        numbers: dict[Track, int] = {}
        self.track = np.array([numbers.setdefault(i.track, len(numbers)) for i in self.ids])
        self._sequence = np.array([submap_id.sequence for submap_id in self.ids])
        self.tracks = [*numbers]

    def touching(
        self, others: _Circles, T_others_self: SE2 = SE2(), own: IntArray | None = None
    ) -> tuple[IntArray, IntArray]:
        """Numbers (N,) of circles, and (N,) those of others that each may touch; in order.

        Of all circles, or of some `own` ones.
        """
        own = np.arange(len(self.ids)) if own is None else own
        center, radius_m = T_others_self.apply(self._center[own]), self._radius_m[own]
        found = [np.zeros((0, 2), np.int64)]
        for start in range(0, len(own), _BLOCK):
            block = slice(start, start + _BLOCK)
            away = center[block, None] - others._center[None]
            reach = radius_m[block, None] + (others._radius_m + _ROUNDING_M)
            near = np.argwhere(np.hypot(away[..., 0], away[..., 1]) <= reach)
            found.append(np.column_stack([own[near[:, 0] + start], near[:, 1]]))
        numbers = np.concatenate(found)
        return numbers[:, 0], numbers[:, 1]

    def touching_each_other(
        self, chosen: Container[SubmapId] | None = None
    ) -> tuple[IntArray, IntArray]:
        """Numbers of pairs that may touch, each once, the smaller number first; in order.

        One of each pair must be among the chosen ones, if there are such.
        """
        if chosen is None:
            first, second = self.touching(self)
            is_once = first < second
            return first[is_once], second[is_once]
        own = np.flatnonzero([submap_id in chosen for submap_id in self.ids])
        pairs = np.sort(np.column_stack(self.touching(self, own=own)), axis=1)
        pairs = np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)
        return pairs[:, 0], pairs[:, 1]

    def are_apart(self, one: IntArray, other: IntArray, num_neighbours: int) -> NDArray[np.bool_]:
        """Whether submaps (N,) are of different tracks, or more than so many steps apart."""
        steps = np.abs(self._sequence[one] - self._sequence[other])
        return (self.track[one] != self.track[other]) | (steps > num_neighbours)


def _share(library: Library, source: SubmapId, target: SubmapId, T_target_source: SE2) -> float:
    """Area that both have seen over the smaller one's."""
    smaller = min(library.submaps[i].area_m2 for i in (source, target))
    return library.shared_area_m2(source, target, T_target_source) / smaller


def _spaced(pairs: Sequence[Ends], num_neighbours: int, limit: int, *, fill: bool) -> list[Ends]:
    """The first ones whose maps share no submap; to fill the limit, then the others."""
    reach = 2 * num_neighbours
    chosen: list[Ends] = []
    rest: list[Ends] = []
    taken: dict[tuple[tuple[str, int], tuple[str, int]], list[tuple[int, int]]] = {}
    for pair in pairs:
        if len(chosen) >= limit:
            return chosen
        source, target = pair
        near = taken.setdefault((source[:2], target[:2]), [])
        if all(
            abs(source.sequence - s) > reach or abs(target.sequence - t) > reach for s, t in near
        ):
            near.append((source.sequence, target.sequence))
            chosen.append(pair)
        else:
            rest.append(pair)
    return [*chosen, *(rest if fill else [])][:limit]
