"""All submaps that are known, and what has been worked out of them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import MAX_MAP_SIDE, OccupancyMap
from uw_dslam_ros2.core.merging.config import (
    INLIER_PROBABILITY,
    LOG_ODDS_MAX,
    MAX_MAP_CELLS,
    NUM_NEIGHBOURS,
)
from uw_dslam_ros2.core.merging.graph.answers import Query
from uw_dslam_ros2.core.merging.graph.components import Component, Constraint
from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.descriptors import NO_SHAPE, MapShape, shape_of
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.odometry import Odometry
from uw_dslam_ros2.core.merging.graph.submap_groups import (
    StoredSubmap,
    SubmapGroup,
    joint_box,
    lattice_box,
    render_group,
    shared_area_m2,
)
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Library", "milestone"]

FloatArray = NDArray[np.float64]

_GROWTH = 1.5
_PART_LENGTH = 6
"""Consecutive submaps in a part of a track's map that is matched by itself."""


def milestone(count: int) -> int:
    """Largest of 1, 2, 3, 4, 6, 9, 13, 19, ... that is not above a count.

    A map is matched anew when it has grown by half, and not with each submap.
    """
    reached = 1
    while (following := max(reached + 1, int(reached * _GROWTH))) <= count:
        reached = following
    return reached


class Library:
    """Groups and sides of one state of the submaps.

    Parameters
    ----------
    submaps
        All; withdrawn ones still carry their track's odometry.
    decisions
        What people decided: the withdrawn ones are neither matched nor drawn, forbidden matches
        do not count, confirmed ones are as sure as odometry.
    memory
        Kept from state to state by the caller.
    """

    def __init__(
        self,
        submaps: Mapping[SubmapId, StoredSubmap],
        decisions: DecisionLog,
        memory: Memory,
    ) -> None:
        self.submaps, self.decisions = submaps, decisions
        self.odometry = Odometry(submaps, memory)
        self._memory = memory
        withdrawn = decisions.withdrawn(submaps)
        self.active = {
            i: s for i, s in sorted(submaps.items()) if i not in withdrawn and len(s.footprint)
        }
        self.confirmed = [
            decision
            for decision in decisions.confirmed
            if all(end in self.active for end in decision.pair)
        ]
        self.by_hand: list[Constraint] = []
        """Constraints in windows that a person laid; part of every graph that is solved."""
        self._by_track: dict[Track, list[SubmapId]] = {}
        for submap_id in self.active:
            self._by_track.setdefault(submap_id.track, []).append(submap_id)
        self._closed = {
            track: [i for i in ids if self.active[i].submap.is_final] or ids
            for track, ids in self._by_track.items()
        }
        out: dict[Track, list[int]] = {}
        for submap_id in sorted(i for i in submaps if i in withdrawn):
            out.setdefault(submap_id.track, []).append(submap_id.sequence)
        # All that groups and sides of one track depend on, in short.
        self._states = {
            track: self.odometry.state(track) + repr(out.get(track)).encode()
            for track in self._by_track
        }
        self._graph_state = self.odometry.states()
        self._track_sides: dict[Track, Side] = {}
        self._without: dict[tuple[Track, ...], Library] = {}

    def without(self, tracks: Sequence[Track]) -> Library:
        """The same without some tracks."""
        key = tuple(tracks)
        if key not in self._without:
            kept = {i: s for i, s in self.submaps.items() if i.track not in key}
            self._without[key] = Library(kept, self.decisions, self._memory)
        return self._without[key]

    def state_of(self, group: SubmapGroup) -> tuple[Hashable, ...]:
        """What is known of the tracks of a group, in short: equal ones are known alike."""
        return tuple(self._states.get(track) for track in self.tracks_of(group))

    def tracks_of(self, group: SubmapGroup) -> list[Track]:
        """The tracks of a group's submaps, sorted."""
        return self._memory.remember(
            ("tracks", group.key), lambda: sorted({i.track for i in group.ids})
        )

    def remember[T](self, key: Hashable, work: Callable[[], T]) -> T:
        """The result under a key that names all that it depends on."""
        return self._memory.remember(key, work)

    def whole_groups(self) -> dict[Track, SubmapGroup]:
        """Each track's map up to its last milestone, of closed submaps where there are any."""
        groups = {}
        for track in self._by_track:
            ids = self.closed(track)
            groups[track] = self._odometry_group(ids[: milestone(len(ids))])
        return groups

    @property
    def tracks(self) -> list[Track]:
        """Those that have something to match, sorted."""
        return sorted(self._by_track)

    def closed(self, track: Track) -> list[SubmapId]:
        """A track's closed submaps; all of them where none is closed yet."""
        return self._closed[track]

    def closed_group(self, track: Track) -> SubmapGroup:
        """All of a track's closed submaps."""
        return self._odometry_group(self.closed(track))

    def window(self, submap_id: SubmapId) -> SubmapGroup:
        """A submap with its neighbours along its track."""
        key = "window", self._states[submap_id.track], submap_id
        return self._memory.remember(key, lambda: self._window(submap_id))

    def _window(self, submap_id: SubmapId) -> SubmapGroup:
        ids = self.closed(submap_id.track)
        index = ids.index(submap_id)
        reach = NUM_NEIGHBOURS if len(ids) > 2 * NUM_NEIGHBOURS + 1 else 0
        low, high = max(0, index - reach), index + reach + 1
        return self._odometry_group(ids[low:high], submap_id)

    def parts(self, side: Side) -> list[SubmapGroup]:
        """Stretches of each track in a side, overlapping by half; never all of a track."""
        groups: list[SubmapGroup] = []
        for track in sorted({submap_id.track for submap_id in side.T_frame_submap}):
            ids = self.closed(track)
            length = min(_PART_LENGTH, -(-len(ids) // 2))
            stride = max(1, length // 2)
            last = len(ids) - length
            for start in sorted({*range(0, last, stride), last}):
                groups.append(self._odometry_group(ids[start : start + length]))
        return groups

    def component_group(self, side: Side) -> SubmapGroup:
        """Everything in a side as one map."""
        ids = sorted(side.T_frame_submap)
        members = [self.active[i] for i in ids]
        poses = [side.T_frame_submap[i] for i in ids]
        return SubmapGroup.of(members, poses, len(ids) // 2)

    def track_side(self, track: Track) -> Side:
        """A track's closed submaps, placed by its own odometry."""
        if track not in self._track_sides:
            side = self.side_of(self.closed(track))
            self._track_sides[track] = replace(side, key=self._states[track])
        return self._track_sides[track]

    def side_of(self, ids: Sequence[SubmapId]) -> Side:
        """Submaps of one track, placed by its own odometry."""
        poses = {i: self.odometry.T_odom_submap(i) for i in ids}
        return Side(poses, self.odometry.covariances)

    def component_side(self, component: Component, track: Track | None = None) -> Side:
        """The closed submaps of a component, or of one track in it, placed by the graph."""
        tracks = sorted({i.track for i in component}) if track is None else [track]
        ids = [i for t in tracks if t in self._by_track for i in self.closed(t)]
        poses = {i: component[i] for i in ids if i in component}
        first = {t: self.closed(t)[0] for t in tracks if t in self._by_track}

        def covariances(targets: Sequence[SubmapId], sources: Sequence[SubmapId]) -> FloatArray:
            over = [
                source if source[:2] == target[:2] else first[target.track]
                for target, source in zip(targets, sources, strict=True)
            ]
            found = self.odometry.covariances(targets, over)
            # Through each track's beginning: an honest guess from above.
            across = [n for n, source in enumerate(sources) if source[:2] != targets[n][:2]]
            ends = [sources[n] for n in across]
            found[across] += self.odometry.covariances(ends, [first[end.track] for end in ends])
            return found

        return Side(poses, covariances)

    def holds(self, query: Query) -> bool:
        """Whether all submaps of a question are still in use."""
        groups = query.source, query.target
        return all(group.T_reference_submap.keys() <= self.active.keys() for group in groups)

    def is_forbidden(self, query: Query) -> bool:
        """Whether people do not want a question asked: a place, or all that there is in it."""
        source, target = query.source, query.target
        if query.prior is not None and self.decisions.is_forbidden(
            source.reference, target.reference
        ):
            return True
        return all(self.decisions.is_forbidden(s, t) for s in source.ids for t in target.ids)

    def why_too_large(self, group: SubmapGroup) -> str:
        """Why a group cannot be made one map; empty if it can."""
        return self._memory.remember(("size", group.key), lambda: self._why_too_large(group))

    def _why_too_large(self, group: SubmapGroup) -> str:
        lattice = self.submaps[group.reference].submap.grid.spec
        boxes = [
            lattice_box(lattice, self.submaps[i].submap.grid.spec, T)
            for i, T in group.T_reference_submap.items()
        ]
        rows, cols = np.diff(joint_box(boxes), axis=0)[0].tolist()
        if max(rows, cols) <= MAX_MAP_SIDE and rows * cols <= MAX_MAP_CELLS:
            return ""
        return (
            f"not matched: the map of {len(boxes)} submaps has {rows:.0f} x {cols:.0f} cells of "
            f"{lattice.resolution_m:g} m, at most {MAX_MAP_SIDE} a side and {MAX_MAP_CELLS:.0e} "
            "in all are"
        )

    def render(self, group: SubmapGroup) -> OccupancyMap:
        """The group's map; not remembered, for its size."""
        occupancy = render_group(group, self.submaps, LOG_ODDS_MAX)
        assert occupancy is not None, "active submaps hold something"
        return occupancy

    def shape(self, group: SubmapGroup) -> MapShape:
        """Descriptor of the group's map."""
        if self.why_too_large(group):
            return NO_SHAPE
        return self._memory.remember(("shape", group.key), lambda: shape_of(self.render(group)))

    def rough_shape(self, track: Track) -> MapShape:
        """Descriptor of a track's map, as it was at its last milestone."""
        ids = self.closed(track)[: milestone(len(self.closed(track)))]
        key = ("rough", tuple((i, self.active[i].digest) for i in ids))
        return self._memory.remember(key, lambda: self.shape(self._odometry_group(ids)))

    def shared_area_m2(self, source: SubmapId, target: SubmapId, T_target_source: SE2) -> float:
        """Area that two submaps have both seen."""
        return shared_area_m2(self.submaps[source], self.submaps[target], T_target_source)

    def solve(
        self, anchor: SubmapId, constraints: Sequence[Constraint]
    ) -> tuple[list[Constraint], list[Component]]:
        """Solve the pose graph; see `solving.solve_components`."""
        # networkx is large, and not every node that starts has something to solve.
        from uw_dslam_ros2.core.merging.graph.solving import solve_components

        allowed = [
            constraint
            for constraint in constraints
            if not self.decisions.is_forbidden(constraint.edge.source, constraint.edge.target)
        ]
        # One answer may serve several matches; it is one edge.
        unique = {constraint.key: constraint for constraint in [*allowed, *self.by_hand]}
        firm = tuple(decision.number for decision in self.confirmed)
        key = self._graph_state, anchor, frozenset(unique), firm
        edges = [*self.odometry.edges, *(decision.edge() for decision in self.confirmed)]
        own = list(unique.values())
        return self._memory.remember_solution(
            key, lambda: solve_components(self.submaps, anchor, edges, own, INLIER_PROBABILITY)
        )

    def _odometry_group(
        self, ids: Sequence[SubmapId], reference: SubmapId | None = None
    ) -> SubmapGroup:
        key = "group", self._states[ids[0].track], ids[0], ids[-1], reference
        return self._memory.remember(key, lambda: self._made_group(ids, reference))

    def _made_group(self, ids: Sequence[SubmapId], reference: SubmapId | None) -> SubmapGroup:
        members = [self.active[i] for i in ids]
        poses = [self.odometry.T_odom_submap(i) for i in ids]
        return SubmapGroup.of(members, poses, ids.index(reference) if reference else len(ids) // 2)
