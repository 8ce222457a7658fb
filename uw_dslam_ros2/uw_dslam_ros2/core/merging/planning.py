"""From submaps and answers to a plan that leaves out what cannot be right."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

from uw_dslam_ros2.core.merging.asking.growing import make_growing_plan
from uw_dslam_ros2.core.merging.asking.pairwise import make_pairwise_plan
from uw_dslam_ros2.core.merging.asking.plan import Plan, make_plan
from uw_dslam_ros2.core.merging.checks.contradictions import contradicting_map
from uw_dslam_ros2.core.merging.checks.soundness import (
    contested_track,
    contradicting_track,
    implausible_submaps,
)
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Component
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.steering.by_hand import matches_by_hand
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.merging.steering.georeference import Fix, Georeference, pulled_by_fixes
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Planning"]


class Planning:
    """Makes plans, and remembers what it has worked out and whom it has set aside."""

    def __init__(self, config: MapQueueConfig) -> None:
        self._config = config
        self._memory = Memory()
        self._implausible: dict[SubmapId, str] = {}
        self._contradicting: list[Track] = []
        self._why: dict[Track, str] = {}
        self.aside: dict[SubmapId, str] = {}
        """What the last plan leaves out, and why."""
        self.doubts: dict[Track, str] = {}
        """Runs that would be set aside if no person wanted them in the map, and why."""

    def library(self, submaps: Mapping[SubmapId, StoredSubmap], decisions: DecisionLog) -> Library:
        """All submaps but those that their own odometry shows to be impossible."""
        self._implausible = implausible_submaps(submaps, self._config.max_speed_m_s, self._memory)
        kept = {i: s for i, s in submaps.items() if i not in self._implausible}
        return Library(kept, decisions, self._memory)

    def forget(self) -> None:
        """Work all out anew: a question has another answer than before."""
        self._memory = Memory()

    def plan(
        self,
        library: Library,
        tracks: Sequence[Track],
        answers: Mapping[QueryKey, Answer],
        standing: AbstractSet[QueryKey],
        anchor: SubmapId | None,
        fixes: Sequence[Fix] = (),
        *,
        is_growing: bool,
    ) -> Plan:
        """A plan without the runs that others agree better without, pulled by fixes.

        Parameters
        ----------
        library
            As `library` gave it.
        tracks
            In order of first arrival.
        answers, standing, anchor
            See `make_plan`.
        fixes
            They pull what has been settled without them: what is asked, and believed, of matches
            does not depend on them.
        is_growing
            Whether more submaps are expected soon.
        """
        plan_with = functools.partial(
            self._plan_with,
            tracks=tracks,
            answers=answers,
            standing=standing,
            anchor=anchor,
            is_growing=is_growing,
        )
        # A person wants them in the map.
        wanted_tracks = {end.track for decision in library.confirmed for end in decision.pair}
        plan = plan_with(library)
        if not is_growing and not plan.wanted:
            self._contradicting, self.doubts = [], {}
            sound = library
            while len(self._contradicting) < len(tracks) and not plan.wanted:
                track, why = self._unsound(sound, plan, answers)
                if track is None:
                    break
                if track in wanted_tracks:
                    self.doubts[track] = why
                    break
                self._contradicting.append(track)
                self._why[track] = why
                sound = library.without(self._contradicting)
                plan = plan_with(sound)
        elif held := [
            track
            for track in self._contradicting
            if track in tracks and track not in wanted_tracks
        ]:
            # While questions are open, what was judged before goes on to hold.
            plan = _asking_first(plan.wanted, plan_with(library.without(held)))
        self.aside = self._implausible | {
            i: f"set aside with its whole run, {self._why[i.track]}"
            for i in library.submaps
            if i.track in self._contradicting and i.track not in wanted_tracks
        }
        return self._pulled(library, plan, fixes)

    def _pulled(self, library: Library, plan: Plan, fixes: Sequence[Fix]) -> Plan:
        if not fixes:
            return plan
        used = [constraint for constraint in plan.constraints if constraint.is_inlier]
        edges: list[Edge] = []
        if self._config.mode != "pairwise":  # that has no graph
            edges += plan.odometry
            edges += [constraint.edge for constraint in used]
            edges += [decision.edge() for decision in library.confirmed]
        components: list[Component] = []
        told: list[Georeference | str] = []
        for component in plan.components:
            own = [edge for edge in edges if {edge.source, edge.target} <= component.keys()]
            key = ("pulled", next(iter(component.items())), frozenset(c.key for c in used),
                   tuple(d.number for d in library.confirmed), library.odometry.states(),
                   tuple(fixes))  # fmt: skip
            work = functools.partial(pulled_by_fixes, component, own, fixes)
            pulled, georeference = library.remember(key, work)
            components.append(pulled)
            told.append(georeference)
        return dataclasses.replace(plan, components=components, georeference=told[0])

    def _unsound(
        self, library: Library, plan: Plan, answers: Mapping[QueryKey, Answer]
    ) -> tuple[Track | None, str]:
        """The run that contradicts the others, by its matches or by its map, and how."""
        if self._config.mode == "pairwise":  # that keeps the first answer, whatever others say
            return None, ""
        track = contradicting_track(library, plan.constraints, min(library.submaps))
        if track is not None:
            return track, "which contradicts the others' maps: most of its matches do not hold"
        contest = contested_track(library, plan.constraints, answers.values(), plan.components)
        if contest is not None:
            return contest.track, (
                f"whose place is contested: accepted matches put it {contest.distance_m:.0f} m "
                "from where others put it, and neither place is clearly more likely"
            )
        found = contradicting_map(library.active, plan.components, self._memory)
        if found is None:
            return None, ""
        return found.track, (
            f"which contradicts the others' maps: {found.num} of its {found.num_judged} submaps "
            "that others have seen too have their walls in free water"
        )

    def _plan_with(
        self,
        library: Library,
        tracks: Sequence[Track],
        answers: Mapping[QueryKey, Answer],
        standing: AbstractSet[QueryKey],
        anchor: SubmapId | None,
        *,
        is_growing: bool,
    ) -> Plan:
        if anchor not in library.submaps:
            anchor = min(library.submaps)
        assert anchor is not None
        if self._config.mode == "pairwise":
            known = [track for track in tracks if any(i.track == track for i in library.submaps)]
            return make_pairwise_plan(library, known, answers, anchor, is_growing=is_growing)
        library.by_hand, wanted = matches_by_hand(library, answers, is_growing=is_growing)
        make = make_growing_plan if is_growing else make_plan
        return _asking_first(wanted, make(library, answers, standing, anchor, self._config))


def _asking_first(questions: Sequence[Query], plan: Plan) -> Plan:
    """A plan that asks something else before its own questions, each of them once."""
    known = {query.key for query in questions}
    own = [query for query in plan.wanted if query.key not in known]
    return dataclasses.replace(plan, wanted=[*questions, *own])
