"""What is to be asked, and what follows from the answers.

A plan depends on the submaps and the answers alone, and not on the order in which they came: it is
worked out anew after each change, and what has been answered is not asked again. So a queue that
was fed in any order comes to the same map, and one that was interrupted goes on where it was.

Its steps; a *track* is one run of one vehicle, and two runs may be joined like two vehicles:

1. Whole maps of two tracks each, the most promising pairs first, without a guess.
2. What was accepted is checked: smaller maps of neighbouring submaps from both sides are matched
   again, each only near where the first match puts it. A match that none of its checks confirms
   is dropped, and the largest set that agrees goes into the graph.
3. Tracks that meet according to the graph, but did not match directly, are matched where they
   meet.
4. Components that are still apart are matched as wholes, and by their most promising parts; what
   is accepted there is checked likewise. This goes on as long as something joins.
5. Where the graph is still vague although two places have seen the same, of one track or of two,
   they are matched near where the graph puts them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from uw_dslam_ros2.core.merging.checks.places import touching_tracks
from uw_dslam_ros2.core.merging.checks.verification import Verifier
from uw_dslam_ros2.core.merging.config import VAGUE_CELLS, MapQueueConfig
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Component, Constraint
from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.descriptors import promise
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.merging.steering.georeference import Georeference
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Pair", "Plan", "component_numbers", "make_plan", "most_promising"]

Pair = tuple[Track, Track]
_MAX_PART_SEARCHES = 4
"""Searches between two components by their most promising parts."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Where everything is, as far as is known, and what to ask next."""

    wanted: list[Query]
    constraints: list[Constraint]
    odometry: list[Edge]
    components: list[Component]
    """The anchor's first, then by smallest submap."""
    georeference: Georeference | str = "there are no fixes"
    """Where the first one lies on earth, or why that is not known."""
    visited: frozenset[QueryKey] = frozenset()
    """Questions whose answers it rests on, and those that it waits for."""


def make_plan(
    library: Library,
    answers: Mapping[QueryKey, Answer],
    standing: AbstractSet[QueryKey],
    anchor: SubmapId,
    config: MapQueueConfig,
) -> Plan:
    """Work out the plan.

    Parameters
    ----------
    library
        The submaps.
    answers
        By the key of the question.
    standing
        Answers that held in the plan before. They go on to hold where this one has not come to
        its own: a map that grows is not torn apart while larger questions are being answered.
    anchor
        The submap that the global frame is pinned to.
    config
        Settings.
    """
    return _Planner(library, answers, standing, anchor, config).run()


class _Planner:
    """One working-out of the plan; the steps of the module's description in `run`."""

    def __init__(
        self,
        library: Library,
        answers: Mapping[QueryKey, Answer],
        standing: AbstractSet[QueryKey],
        anchor: SubmapId,
        config: MapQueueConfig,
    ) -> None:
        self._library, self._config, self._anchor = library, config, anchor
        self._answers, self._standing = answers, standing
        self._verifier = Verifier(library, answers)
        self._groups = library.whole_groups()

    def run(self) -> Plan:
        """Work the plan out; the steps of the module's description."""
        ranked = self._ranked(self._groups)
        first = most_promising(ranked, self._config.max_partners)
        constraints = self._match_tracks(first)
        if not self._is_waiting():
            tried = set(first)
            apart = self._apart(constraints, [pair for pair in ranked if pair not in tried])
            constraints += self._match_tracks(apart)
        if not self._is_waiting():
            constraints += self._match_meeting(constraints)
        for _ in range(len(self._groups)):
            if self._is_waiting():
                break
            more = self._match_components(constraints)
            if not more:
                break
            constraints += more
        if not self._is_waiting():
            constraints += self._tighten(constraints)
        return self._finish(constraints)

    def _is_waiting(self) -> bool:
        return bool(self._verifier.wanted)

    def _ranked(self, groups: Mapping[Track, SubmapGroup]) -> list[Pair]:
        """Pairs of tracks, most promising first."""
        shapes = {track: self._library.shape(group) for track, group in groups.items()}
        pairs = itertools.combinations(sorted(groups), 2)
        return sorted(pairs, key=lambda p: (-promise(shapes[p[0]], shapes[p[1]]), p))

    def _match_tracks(self, pairs: Iterable[Pair]) -> list[Constraint]:
        constraints: list[Constraint] = []
        for target, source in pairs:
            query = Query(self._groups[source], self._groups[target])
            sides = self._library.track_side(source), self._library.track_side(target)
            constraints += self._verifier.constraints_of(query, *sides)
        return constraints

    def _apart(self, constraints: Sequence[Constraint], pairs: Iterable[Pair]) -> list[Pair]:
        """Pairs whose tracks are in different components."""
        _, components = self._solve(constraints)
        where = component_numbers(components)
        return [(a, b) for a, b in pairs if where[self._group_id(a)] != where[self._group_id(b)]]

    def _group_id(self, track: Track) -> SubmapId:
        return self._groups[track].reference

    def _match_meeting(self, constraints: Sequence[Constraint]) -> list[Constraint]:
        """Step 3: a prior from the graph for tracks without a match of their own."""
        solved, components = self._solve(constraints)
        where = component_numbers(components)
        matched = {
            frozenset((j.edge.source.track, j.edge.target.track)) for j in solved if j.is_inlier
        }
        number = {track: where[self._group_id(track)] for track in self._groups}
        sides = {t: self._library.component_side(components[i], t) for t, i in number.items()}
        found: list[Constraint] = []
        near: set[frozenset[Track]] = set()
        for component in components:
            near |= touching_tracks(self._library, self._library.component_side(component))
        near -= matched
        for target, source in itertools.combinations(sorted(self._groups), 2):
            pair = frozenset((source, target))
            if number[source] == number[target] and pair in near:
                found += self._verifier.constraints_nearby(sides[source], sides[target])
        return found

    def _match_components(self, constraints: Sequence[Constraint]) -> list[Constraint]:
        """Step 4."""
        _, components = self._solve(constraints)
        sides = [self._library.component_side(component) for component in components]
        sides = [side for side in sides if side.T_frame_submap]
        candidates: list[tuple[float, Query, Side, Side]] = []
        for target, source in itertools.combinations(sides, 2):
            candidates += self._between(source, target)
            candidates += self._between(target, source, is_turned=True)
        candidates.sort(key=lambda c: (-c[0], c[1].key))
        found: list[Constraint] = []
        taken: dict[frozenset[SubmapId], int] = {}
        seen = {frozenset((key[0], key[1])) for key in self._verifier.visited}
        for _, query, source_side, target_side in candidates:
            groups = frozenset((query.source.key, query.target.key))
            if groups in seen:
                continue  # asked before, perhaps the other way round
            seen.add(groups)
            ends = frozenset((min(source_side.T_frame_submap), min(target_side.T_frame_submap)))
            taken[ends] = taken.get(ends, 0) + 1
            if taken[ends] <= _MAX_PART_SEARCHES:
                found += self._verifier.constraints_of(query, source_side, target_side)
        return found

    def _tighten(self, constraints: Sequence[Constraint]) -> list[Constraint]:
        """Step 5."""
        solved, components = self._solve(constraints)
        inliers = [constraint for constraint in solved if constraint.is_inlier]
        found: list[Constraint] = []
        for component in components:
            side = self._library.component_side(component)
            limit = len(
                side.T_frame_submap
            )  # one for each submap, so that time grows with their number
            found += self._verifier.constraints_where_vague(side, inliers, VAGUE_CELLS, limit)
        return found

    def _between(
        self, source: Side, target: Side, *, is_turned: bool = False
    ) -> list[tuple[float, Query, Side, Side]]:
        """Parts of one component (or all of it) against all of another, with their promise."""
        whole = self._library.component_group(target)
        target_shape = self._library.shape(whole)
        groups = self._library.parts(source)
        tracks = {i.track for side in (source, target) for i in side.T_frame_submap}
        if len(tracks) > 2 and not is_turned:
            groups.append(self._library.component_group(source))
        found = []
        for group in groups:
            worth = promise(self._library.shape(group), target_shape)
            found.append((worth, Query(group, whole), source, target))
        return found

    def _finish(self, constraints: list[Constraint]) -> Plan:
        solved, components = self._solve(constraints)
        carried = self._carried(solved, components)
        if carried:
            solved, components = self._solve([*constraints, *carried])
        wanted = sorted(self._verifier.wanted.values(), key=self._is_joined(solved))
        visited = frozenset(self._verifier.visited)
        return Plan(wanted, solved, self._library.odometry.edges, components, visited=visited)

    def _carried(
        self, solved: Sequence[Constraint], components: Sequence[Component]
    ) -> list[Constraint]:
        """Standing answers that this plan has not asked for, where it has nothing of its own."""
        own = {
            frozenset((j.edge.source.track, j.edge.target.track)) for j in solved if j.is_inlier
        }
        where = component_numbers(components)
        carried: list[Constraint] = []
        for key in sorted(self._standing - self._verifier.visited):
            answer = self._answers.get(key)
            if answer is None or not self._library.holds(answer.query):
                continue
            constraint = self._verifier.constraint(answer)
            ends = constraint.edge.source, constraint.edge.target
            is_own = frozenset((ends[0].track, ends[1].track)) in own
            is_apart = where[ends[0]] != where[ends[1]]
            if is_apart or (self._is_waiting() and not is_own):
                carried.append(constraint)
        return carried

    def _is_joined(self, constraints: Sequence[Constraint]):  # type: ignore[no-untyped-def]
        joined = {
            frozenset((j.edge.source.track, j.edge.target.track))
            for j in constraints
            if j.is_inlier
        }

        def key(query: Query) -> bool:
            return (
                frozenset((query.source.reference.track, query.target.reference.track)) in joined
            )

        return key

    def _solve(
        self, constraints: Sequence[Constraint]
    ) -> tuple[list[Constraint], list[Component]]:
        return self._library.solve(self._anchor, constraints)


def most_promising(ranked: Sequence[Pair], max_partners: int) -> list[Pair]:
    """Of ranked pairs, those that are among the best few of either track."""
    count: dict[Track, int] = {}
    chosen: list[Pair] = []
    for pair in ranked:
        if min(count.get(track, 0) for track in pair) < max_partners:
            chosen.append(pair)
            for track in pair:
                count[track] = count.get(track, 0) + 1
    return chosen


def component_numbers(components: Sequence[Component]) -> dict[SubmapId, int]:
    """Index of the component of each submap."""
    return {
        submap_id: index for index, component in enumerate(components) for submap_id in component
    }
