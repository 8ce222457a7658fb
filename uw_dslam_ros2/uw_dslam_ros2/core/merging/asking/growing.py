"""What is to be asked while the maps still grow: only what can change something now.

The plan of `plan` is worked out for maps that are there as a whole; asked again with every submap
it would ask nearly all of its questions each time. While more is expected, this plan is used:

1. What holds goes on to hold.
2. Tracks that are still apart are matched as wholes, the most promising pair first and one
   question for each track at a time; a pair that was refused only when the two maps have grown
   so much together that another answer can be hoped for.
3. What was accepted is checked as in `plan`; checks of the same submaps count, although their
   poses have moved a little since.
4. A new submap of a track that is joined is matched once, where it has seen most of what was
   seen before, if the graph is vague there.

When the vehicles have come to rest, `plan` asks what is left to ask, and decides: so the map in
the end does not depend on what was asked in between.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet

from uw_dslam_ros2.core.merging.asking.plan import Pair, Plan, component_numbers, most_promising
from uw_dslam_ros2.core.merging.checks.verification import Verifier
from uw_dslam_ros2.core.merging.config import NUM_NEIGHBOURS, VAGUE_CELLS, MapQueueConfig
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey, Use
from uw_dslam_ros2.core.merging.graph.components import Component, Constraint
from uw_dslam_ros2.core.merging.graph.descriptors import promise
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["make_growing_plan"]


def make_growing_plan(
    library: Library,
    answers: Mapping[QueryKey, Answer],
    standing: AbstractSet[QueryKey],
    anchor: SubmapId,
    config: MapQueueConfig,
) -> Plan:
    """Work out the plan; parameters as of `make_plan`."""
    return _GrowingPlanner(library, answers, standing, anchor, config).run()


class _GrowingPlanner:
    """One working-out of the plan; the steps of the module's description in `run`."""

    def __init__(
        self,
        library: Library,
        answers: Mapping[QueryKey, Answer],
        standing: AbstractSet[QueryKey],
        anchor: SubmapId,
        config: MapQueueConfig,
    ) -> None:
        self._library, self._anchor, self._config = library, anchor, config
        self._verifier = Verifier(library, answers, is_lenient=True)
        self._standing = [
            answers[key]
            for key in sorted(standing)
            if key in answers and library.holds(answers[key].query)
        ]
        self._claims = _claims(library, answers.values())

    def run(self) -> Plan:
        """Work the plan out; the steps of the module's description."""
        constraints = [self._verifier.constraint(answer) for answer in self._standing]
        solved, components = self._solve(constraints)
        for pair in self._apart(components):
            constraints += self._check_claims(pair)
        solved, components = self._solve(constraints)
        if not self._verifier.wanted:
            self._ask_best(self._apart(components))
        for component in components:
            constraints += self._tie_newest(component, solved)
        solved, components = self._solve(constraints)
        wanted = list(self._verifier.wanted.values())
        return Plan(wanted, solved, self._library.odometry.edges, components)

    def _solve(
        self, constraints: Sequence[Constraint]
    ) -> tuple[list[Constraint], list[Component]]:
        return self._library.solve(self._anchor, constraints)

    def _apart(self, components: Sequence[Component]) -> list[Pair]:
        """The best pairs of tracks of different components, the most promising first."""
        where = component_numbers(components)
        number = {t: where[self._library.closed(t)[0]] for t in self._library.tracks}
        pairs = [
            pair
            for pair in itertools.combinations(self._library.tracks, 2)
            if number[pair[0]] != number[pair[1]]
        ]
        if len(pairs) < 2:
            return pairs
        shapes = {t: self._library.rough_shape(t) for pair in pairs for t in pair}
        pairs.sort(key=lambda p: (-promise(shapes[p[0]], shapes[p[1]]), p))
        return most_promising(pairs, self._config.max_partners)

    def _check_claims(self, pair: Pair) -> list[Constraint]:
        """Constraints of earlier answers that may be right, the one of the largest maps first."""
        for answer in self._claims.get(pair, ()):
            if answer.use < Use.CLAIM:
                continue
            # The whole tracks: submaps that have come since lie between those that were asked.
            sides = [
                self._library.track_side(group.reference.track)
                for group in (answer.query.source, answer.query.target)
            ]
            constraints = self._verifier.constraints_of(answer.query, sides[0], sides[1])
            if constraints or self._verifier.wanted:
                return constraints
        return []

    def _ask_best(self, pairs: Iterable[Pair]) -> None:
        busy: set[Track] = set()
        for target, source in pairs:
            if busy.isdisjoint((target, source)) and self._has_grown((target, source)):
                groups = self._library.closed_group(source), self._library.closed_group(target)
                self._verifier.ask(Query(*groups))
                busy |= {target, source}

    def _has_grown(self, pair: Pair) -> bool:
        """Whether both maps together have grown enough since the last answer."""
        now = len(self._library.closed(pair[0])) * len(self._library.closed(pair[1]))
        asked = max((_size(answer) for answer in self._claims.get(pair, ())), default=0)
        return now >= self._config.growth**2 * asked and now > asked

    def _tie_newest(
        self, component: Component, constraints: Sequence[Constraint]
    ) -> list[Constraint]:
        """Step 4: the newest place of each track whose neighbours are there."""
        side = self._library.component_side(component)
        reach = NUM_NEIGHBOURS
        newest = set()
        for track in {submap_id.track for submap_id in side.T_frame_submap}:
            ids = self._library.closed(track)
            newest.add(ids[max(0, len(ids) - 1 - reach)])
        inliers = [constraint for constraint in constraints if constraint.is_inlier]
        vague_cells = self._config.growth * VAGUE_CELLS
        return self._verifier.constraints_where_vague(side, inliers, vague_cells, 1, newest)


def _claims(library: Library, answers: Iterable[Answer]) -> dict[Pair, list[Answer]]:
    """Answers to questions without a guess, of one track's map in another's; largest first."""
    found: dict[Pair, list[Answer]] = {}
    for answer in answers:
        query = answer.query
        if query.prior is not None:
            continue
        source, target = library.tracks_of(query.source), library.tracks_of(query.target)
        is_pair = len(source) == len(target) == 1 and source != target
        if is_pair and library.holds(query):
            first, second = sorted([*source, *target])
            found.setdefault((first, second), []).append(answer)
    for claims in found.values():
        claims.sort(key=lambda answer: (-_size(answer), answer.query.key))
    return found


def _size(answer: Answer) -> int:
    return len(answer.query.source.ids) * len(answer.query.target.ids)
