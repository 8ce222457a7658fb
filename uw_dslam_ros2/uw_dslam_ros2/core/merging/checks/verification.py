"""Is a match true? Ask again where it would have to show."""

from __future__ import annotations

import functools
import math
from collections.abc import Container, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.checks.places import (
    Ends,
    meetings,
    pose_uncertainty,
    sigma_m,
    vague_places,
)
from uw_dslam_ros2.core.merging.checks.voting import ENOUGH_ODDS, Vote, vote_of, weigh
from uw_dslam_ros2.core.merging.config import INLIER_PROBABILITY, MAX_CHECKS, NUM_NEIGHBOURS
from uw_dslam_ros2.core.merging.graph.answers import Answer, AnswerBook, Query, QueryKey, Use
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.constraints import constraint_of
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import invert_covariance
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Verifier"]

FloatArray = NDArray[np.float64]

_NUM_ROUNDS = 3
"""Where the first checks leave it open, as many again are asked at other places."""
_PRIOR_SIGMA = 3.0
_PRIOR_SHARE = 0.1
_PRIOR_RAD = 0.15
"""A prior is never narrower than a tenth of the map's radius and some nine degrees."""
_PRIOR_STEP, _PRIOR_RATIO = 0.2, 2.0**0.25
"""Priors lie on a lattice of 0.2 half-widths, and half-widths in a geometric series: so a graph
that moves by a little asks no new questions.
"""


class Verifier:
    """Turns questions into constraints; collects the questions that are not answered yet."""

    def __init__(
        self,
        library: Library,
        answers: Mapping[QueryKey, Answer],
        *,
        is_lenient: bool = False,
    ) -> None:
        self._library = library
        self._book = AnswerBook(answers, is_lenient=is_lenient)
        self.wanted: dict[QueryKey, Query] = {}
        self.visited: set[QueryKey] = set()

    def constraints_of(self, query: Query, source: Side, target: Side) -> list[Constraint]:
        """Constraints that a match and its checks make; none while an answer is missing.

        Parameters
        ----------
        query
            The question, without a prior.
        source, target
            All that the two maps belong to.
        """
        answer = self.ask(query)
        if answer is None or answer.use < Use.CLAIM:
            return []
        main = self._vote(answer)
        edge = main.constraint.edge
        T_target_source = (
            target.T_frame_submap[edge.target]
            @ edge.T_target_source
            @ source.T_frame_submap[edge.source].inverse()
        )
        checks = self._checks(query, edge, T_target_source, source, target)
        if not checks:
            # Two single submaps are all there is to ask about; otherwise they would have met.
            is_single = len(query.source.ids) == len(query.target.ids) == 1
            return [main.constraint] if is_single and answer.is_accepted else []
        step = MAX_CHECKS
        for count in range(step, len(checks) + step, step):
            replies = self._ask_all(checks[:count])
            if replies is None:
                return []
            votes = [main, *self._votes(replies)]
            believed, odds = self._weigh(votes, len(replies), source, target)
            if odds >= ENOUGH_ODDS:
                return believed
        return []

    def constraints_nearby(self, source: Side, target: Side) -> list[Constraint]:
        """Constraints between two tracks of one component, where the graph lets them meet."""
        checks = self._checks(None, None, SE2(), source, target)[:MAX_CHECKS]
        if not checks:
            return []
        replies = self._ask_all(checks)
        if replies is None:
            return []
        return self._weigh(self._votes(replies), len(replies), source, target)[0]

    def constraints_where_vague(
        self,
        side: Side,
        constraints: Sequence[Constraint],
        vague_cells: float,
        limit: int,
        chosen: Container[SubmapId] | None = None,
    ) -> list[Constraint]:
        """Further constraints inside one component, where they tell most; see `vague_places`."""
        inside = [
            constraint
            for constraint in constraints
            if constraint.edge.source in side.T_frame_submap
        ]
        edges = [constraint.edge for constraint in inside]
        places = vague_places(
            self._library, side, edges, NUM_NEIGHBOURS, vague_cells, limit, chosen
        )
        groups: dict[frozenset[Track], list[Query]] = {}
        for ends, uncertainty in places:
            check = self._check(ends, side.between(ends[1], ends[0]), uncertainty)
            if self._library.is_forbidden(check):
                continue
            groups.setdefault(frozenset((ends[0].track, ends[1].track)), []).append(check)
        found: list[Constraint] = []
        for tracks, checks in sorted(groups.items(), key=lambda item: sorted(item[0])):
            replies = self._ask_all(checks)
            if replies is None:
                continue
            new = self._votes(replies)
            old = [
                Vote(constraint, None, is_accepted=True)
                for constraint in inside
                if {constraint.edge.source.track, constraint.edge.target.track} == tracks
            ]
            keys = {vote.constraint.key for vote in new}
            believed, _ = self._weigh([*old, *new], len(replies), side, side)
            found += [constraint for constraint in believed if constraint.key in keys]
        return found

    def constraint(self, answer: Answer) -> Constraint:
        """The edge of an answer; see `constraint_of`."""
        return constraint_of(self._library, answer)

    def ask(self, query: Query) -> Answer | None:
        """The answer, if there is one; otherwise the question is noted as wanted."""
        if self._library.is_forbidden(query):
            refused = RegistrationResult.refused(Verdict.CONTRADICTED, "forbidden by a person")
            return Answer.of(query, refused)
        answer = self._book.find_similar(query)
        if answer is not None:
            return answer
        self.visited.add(query.key)
        answer = self._book.find(query) or self._refusal(query)
        if answer is None:
            self.wanted.setdefault(query.key, query)
        return answer

    def _refusal(self, query: Query) -> Answer | None:
        """The answer to what cannot be asked."""
        for group in (query.source, query.target):
            if why := self._library.why_too_large(group):
                refused = RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, why)
                return Answer.of(query, refused)
        return None

    def _checks(
        self,
        query: Query | None,
        main: Edge | None,
        T_target_source: SE2,
        source: Side,
        target: Side,
    ) -> list[Query]:
        """Questions at the places where the two sides share most, away from each other."""
        work = functools.partial(self._made_checks, query, main, T_target_source, source, target)
        if query is None or main is None or source.key is None or target.key is None:
            checks = work()
        else:
            ends = main.source, main.target, main.T_target_source
            key = "checks", query.key, ends, source.key, target.key
            checks = self._library.remember(key, work)
        return [check for check in checks if not self._library.is_forbidden(check)]

    def _made_checks(
        self,
        query: Query | None,
        main: Edge | None,
        T_target_source: SE2,
        source: Side,
        target: Side,
    ) -> list[Query]:
        places = meetings(
            self._library,
            T_target_source,
            source,
            target,
            NUM_NEIGHBOURS,
            _NUM_ROUNDS * MAX_CHECKS,
        )
        checks: list[Query] = []
        for source_id, target_id in places:
            groups = self._library.window(source_id), self._library.window(target_id)
            if query is not None and (query.source.ids, query.target.ids) == (
                groups[0].ids,
                groups[1].ids,
            ):
                continue  # the same maps once more would confirm themselves
            T_between = (
                target.T_frame_submap[target_id].inverse()
                @ T_target_source
                @ source.T_frame_submap[source_id]
            )
            ends = (source_id, target_id)
            checks.append(
                self._check(ends, T_between, pose_uncertainty(main, ends, source, target))
            )
        return checks

    def _check(self, ends: Ends, T_target_source: SE2, covariance: FloatArray) -> Query:
        """A question near a guess; always the same way round, so that none is asked twice."""
        if ends[0] < ends[1]:
            covariance = invert_covariance(covariance, T_target_source)
            ends, T_target_source = (ends[1], ends[0]), T_target_source.inverse()
        source, target = self._library.window(ends[0]), self._library.window(ends[1])
        radius_m = max(self._library.submaps[i].radius_m for i in ends)
        half_m = _PRIOR_SIGMA * sigma_m(covariance) + _PRIOR_SHARE * radius_m
        half_rad = _PRIOR_SIGMA * math.sqrt(float(covariance[2, 2])) + _PRIOR_RAD
        return Query(source, target, _prior_around(T_target_source, half_m, half_rad))

    def _vote(self, answer: Answer) -> Vote:
        return vote_of(self.constraint(answer), answer)

    def _votes(self, replies: Sequence[Answer]) -> list[Vote]:
        return [self._vote(reply) for reply in replies if reply.use >= Use.VOTE]

    def _weigh(
        self, votes: Sequence[Vote], num_checks: int, source: Side, target: Side
    ) -> tuple[list[Constraint], float]:
        work = functools.partial(weigh, votes, num_checks, source, target, INLIER_PROBABILITY)
        if source.key is None or target.key is None:
            return work()
        said = tuple((v.constraint.key, v.constraint.edge.T_target_source) for v in votes)
        return self._library.remember(("weigh", said, num_checks, source.key, target.key), work)

    def _ask_all(self, queries: Sequence[Query]) -> list[Answer] | None:
        """All answers, or None while one is missing."""
        replies = [reply for query in queries if (reply := self.ask(query)) is not None]
        return replies if len(replies) == len(queries) else None


def _prior_around(guess: SE2, half_width_m: float, half_width_rad: float) -> PriorWindow:
    """A window of the lattice of windows that holds the given one."""
    widths = []
    for half_width in (half_width_m, half_width_rad):
        wanted = half_width / (1.0 - 0.5 * _PRIOR_STEP)
        power = math.ceil(math.log(wanted) / math.log(_PRIOR_RATIO) - 1e-9)
        widths.append(_PRIOR_RATIO**power)
    steps = np.array([widths[0], widths[0], widths[1]]) * _PRIOR_STEP
    # Adding nothing turns -0.0, which is the same but reads differently, into 0.0.
    middle = np.round(steps * np.round(guess.as_array() / steps), 6) + 0.0
    return PriorWindow(
        SE2.from_array(middle), round(widths[0], 3), round(min(widths[1], math.pi), 4)
    )
