"""Is a match true? Ask again where it would have to show."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from uw_dslam_ros2.core.mapping.submap import SubmapId
from uw_dslam_ros2.core.merging.answers import Answer, Match, MatchKey
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.consistency import Side, consistent_set, cycle_of
from uw_dslam_ros2.core.merging.graph import Edge, compose_covariance, invert_covariance
from uw_dslam_ros2.core.merging.library import Library
from uw_dslam_ros2.core.merging.settling import Joint
from uw_dslam_ros2.core.merging.units import Unit
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Verifier"]

FloatArray = NDArray[np.float64]

_MIN_SHARE = 0.25
"""Least common area of two submaps, as a share of the smaller, that is worth a check."""
_MIN_VAGUE_SHARE = 0.4
"""The same for a further joint, which nothing depends on."""
_NUM_ROUNDS = 2
"""Where the first checks leave it open, as many again are asked at other places."""
_WORTH_CHECKING = 0.5
"""A match that was refused as not sure enough is still checked if it is this likely."""
_PASS = 0.6
"""How often a check of a true match agrees with it."""
_LEAST_CHANCE = 0.05
"""How often a check of a false match agrees with it at least: mistakes have common causes."""
_ENOUGH_ODDS, _ODDS_BEYOND_DOUBT = 10.0, 1000.0
"""A match is believed if its checks make it ten times as likely as not, or a thousand times where
none of the answers was accepted by itself.
"""
_PRIOR_SIGMA = 3.0
_PRIOR_SHARE = 0.1
_PRIOR_RAD = 0.15
"""A prior is never narrower than a tenth of the map's radius and some nine degrees."""


class Verifier:
    """Turns questions into joints; collects the questions that are not answered yet."""

    def __init__(
        self, library: Library, answers: Mapping[MatchKey, Answer], config: MapQueueConfig
    ) -> None:
        self._library, self._answers, self._config = library, answers, config
        self.wanted: dict[MatchKey, Match] = {}
        self.visited: set[MatchKey] = set()
        self._replies: dict[tuple[bytes, bytes], list[Answer]] = {}

    def joints_of(self, match: Match, source: Side, target: Side) -> list[Joint]:
        """Joints that a match and its checks make; none while an answer is missing.

        Parameters
        ----------
        match
            The question, without a prior.
        source, target
            All that the two maps belong to.
        """
        answer = self.ask(match)
        if answer is None or not answer.is_guess:
            return []
        if not answer.is_accepted and answer.probability < _WORTH_CHECKING:
            return []
        main = self._vote(answer)
        edge = main.joint.edge
        T_target_source = (
            target.T_frame_submap[edge.target]
            @ edge.T_target_source
            @ source.T_frame_submap[edge.source].inverse()
        )
        checks = self._checks(match, edge, T_target_source, source, target)
        if not checks:
            # Two single submaps are all there is to ask about; otherwise they would have met.
            is_single = len(match.source.ids) == len(match.target.ids) == 1
            return [main.joint] if is_single and answer.is_accepted else []
        step = self._config.max_checks
        for count in range(step, len(checks) + step, step):
            replies = self._ask_all(checks[:count])
            if replies is None:
                return []
            votes = [main, *self._votes(replies)]
            believed, odds = self._weigh(votes, len(replies), source, target)
            if odds >= _ENOUGH_ODDS:
                return believed
        return []

    def joints_nearby(self, source: Side, target: Side) -> list[Joint]:
        """Joints between two vehicles of one component, where the graph says that they meet."""
        checks = self._checks(None, None, SE2(), source, target)[: self._config.max_checks]
        replies = self._ask_all(checks)
        if replies is None:
            return []
        return self._weigh(self._votes(replies), len(replies), source, target)[0]

    def joints_where_vague(self, side: Side, joints: Sequence[Joint]) -> list[Joint]:
        """Further joints inside one component, where they would tell most."""
        inside = [joint for joint in joints if joint.edge.source in side.T_frame_submap]
        groups: dict[frozenset[str], list[Match]] = {}
        for check in self._vague_places(side, [joint.edge for joint in inside]):
            vehicles = frozenset((check.source.reference[0], check.target.reference[0]))
            groups.setdefault(vehicles, []).append(check)
        found: list[Joint] = []
        for vehicles, checks in sorted(groups.items(), key=lambda item: sorted(item[0])):
            replies = self._ask_all(checks)
            if replies is None:
                continue
            new = self._votes(replies)
            old = [
                _Vote(joint, None, True)
                for joint in inside
                if {joint.edge.source[0], joint.edge.target[0]} == vehicles
            ]
            keys = {vote.joint.key for vote in new}
            believed, _ = self._weigh([*old, *new], len(replies), side, side)
            found += [joint for joint in believed if joint.key in keys]
        return found

    def _vague_places(self, side: Side, edges: Sequence[Edge]) -> list[Match]:
        """Pairs of places that have seen the same, by how little is known between them."""
        candidates: list[tuple[float, SubmapId, SubmapId, FloatArray]] = []
        ids = sorted(side.T_frame_submap)
        for target_id, source_id in itertools.combinations(ids, 2):
            if not _is_apart(source_id, target_id, 2 * self._config.num_neighbours + 1):
                continue
            share = self._share(source_id, target_id, side.between(target_id, source_id))
            if share < _MIN_VAGUE_SHARE:
                continue
            uncertainty = self._known_best(source_id, target_id, side, edges)
            sigma_m = _sigma_m(uncertainty)
            cell_m = self._library.submaps[target_id].submap.grid.spec.resolution_m
            if sigma_m > self._config.vague_cells * cell_m:
                candidates.append((share * sigma_m, source_id, target_id, uncertainty))
        candidates.sort(key=lambda item: (-item[0], item[1], item[2]))
        pairs = [(source_id, target_id) for _, source_id, target_id, _ in candidates]
        places = set(self._spaced(pairs, round(self._config.vague_share * len(ids)), fill=False))
        checks: list[Match] = []
        for _, source_id, target_id, uncertainty in candidates:
            ends = source_id, target_id
            if ends in places:
                checks.append(self._check(ends, side.between(target_id, source_id), uncertainty))
        return checks

    def _known_best(
        self, source_id: SubmapId, target_id: SubmapId, side: Side, edges: Sequence[Edge]
    ) -> FloatArray:
        """Covariance (3, 3) of a relative pose along odometry, or over the best single edge."""
        known = [side.covariance(target_id, source_id)] if source_id[0] == target_id[0] else []
        for edge in edges:
            if (edge.source[0], edge.target[0]) == (source_id[0], target_id[0]):
                known.append(self._uncertainty(edge, (source_id, target_id), side, side))
            elif (edge.target[0], edge.source[0]) == (source_id[0], target_id[0]):
                known.append(
                    self._uncertainty(edge.reversed(), (source_id, target_id), side, side)
                )
        if not known:
            known = [side.covariance(target_id, source_id)]
        return min(known, key=_sigma_m)

    def _share(self, source_id: SubmapId, target_id: SubmapId, T_target_source: SE2) -> float:
        """Area that both have seen over the smaller one's."""
        smaller = min(self._library.submaps[i].area_m2 for i in (source_id, target_id))
        return self._library.shared_area_m2(source_id, target_id, T_target_source) / smaller

    def joint(self, answer: Answer) -> Joint:
        """The edge of an accepted answer, between the two submaps that share most."""
        source, target = answer.match.source, answer.match.target
        T_target_source = answer.T_target_source
        ends = self._ends(source, target, T_target_source)
        left = target.T_reference_submap[ends[1]].inverse()
        right = source.T_reference_submap[ends[0]]
        edge = Edge(
            *ends,
            left @ T_target_source @ right,
            compose_covariance(answer.covariance, left, T_target_source, right),
        )
        covariance = edge.covariance + self._distrust(source, target, edge)
        edge = Edge(edge.source, edge.target, edge.T_target_source, covariance)
        return Joint(answer.match.key, edge, answer.probability)

    def _ends(self, source: Unit, target: Unit, T_target_source: SE2) -> tuple[SubmapId, SubmapId]:
        best = (-1.0, source.reference, target.reference)
        for source_id, T_source in source.T_reference_submap.items():
            T_target = T_target_source @ T_source
            for target_id, T_other in target.T_reference_submap.items():
                T_between = T_other.inverse() @ T_target
                area = self._library.shared_area_m2(source_id, target_id, T_between)
                if area > best[0]:
                    best = area, source_id, target_id
        return best[1], best[2]

    def _distrust(self, source: Unit, target: Unit, edge: Edge) -> FloatArray:
        """Covariance (3, 3) that a registration cannot know of: the cells, and bent maps."""
        cell_m = (
            self._config.edge_sigma_cells
            * self._library.submaps[edge.target].submap.grid.spec.resolution_m
        )
        radius_m = min(self._library.submaps[i].radius_m for i in (edge.source, edge.target))
        cell_rad = cell_m / max(radius_m, cell_m)
        floor = np.diag([cell_m**2, cell_m**2, cell_rad**2])
        odometry = self._library.odometry
        bent_source = odometry.spread(edge.source, source.ids)
        bent_target = odometry.spread(edge.target, target.ids)
        motion = edge.T_target_source
        return floor + bent_target + compose_covariance(bent_source, motion, SE2(), SE2())

    def _checks(
        self,
        match: Match | None,
        main: Edge | None,
        T_target_source: SE2,
        source: Side,
        target: Side,
    ) -> list[Match]:
        """Questions at the places where the two sides share most, away from each other."""
        checks: list[Match] = []
        for source_id, target_id in self._meetings(T_target_source, source, target):
            units = self._library.window(source_id), self._library.window(target_id)
            if match is not None and (match.source.ids, match.target.ids) == (
                units[0].ids,
                units[1].ids,
            ):
                continue  # the same maps once more would confirm themselves
            T_between = (
                target.T_frame_submap[target_id].inverse()
                @ T_target_source
                @ source.T_frame_submap[source_id]
            )
            ends = (source_id, target_id)
            uncertainty = self._uncertainty(main, ends, source, target)
            checks.append(self._check(ends, T_between, uncertainty))
        return checks

    def _meetings(
        self, T_target_source: SE2, source: Side, target: Side
    ) -> list[tuple[SubmapId, SubmapId]]:
        shares: list[tuple[float, SubmapId, SubmapId]] = []
        for source_id, T_source in source.T_frame_submap.items():
            T_there = T_target_source @ T_source
            for target_id, T_target in target.T_frame_submap.items():
                share = self._share(source_id, target_id, T_target.inverse() @ T_there)
                if share >= _MIN_SHARE:
                    shares.append((share, source_id, target_id))
        shares.sort(key=lambda item: (-item[0], item[1], item[2]))
        pairs = [(source_id, target_id) for _, source_id, target_id in shares]
        return self._spaced(pairs, _NUM_ROUNDS * self._config.max_checks, fill=True)

    def _spaced(
        self, pairs: Sequence[tuple[SubmapId, SubmapId]], limit: int, *, fill: bool
    ) -> list[tuple[SubmapId, SubmapId]]:
        """The first ones whose maps share no submap; to fill the limit, then the others."""
        reach = 2 * self._config.num_neighbours
        chosen: list[tuple[SubmapId, SubmapId]] = []
        for pair in pairs:
            if len(chosen) >= limit:
                return chosen
            if all(
                _is_apart(pair[0], s, reach) or _is_apart(pair[1], t, reach) for s, t in chosen
            ):
                chosen.append(pair)
        rest = [pair for pair in pairs if pair not in chosen] if fill else []
        return [*chosen, *rest][:limit]

    def _uncertainty(
        self, main: Edge | None, ends: tuple[SubmapId, SubmapId], source: Side, target: Side
    ) -> FloatArray:
        """Covariance (3, 3) of where the source of a check lies in its target."""
        if main is None:
            # Joined through others: as uncertain as the way along both vehicles.
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

    def _check(
        self, ends: tuple[SubmapId, SubmapId], T_target_source: SE2, covariance: FloatArray
    ) -> Match:
        """A question near a guess; always the same way round, so that none is asked twice."""
        if ends[0] < ends[1]:
            covariance = invert_covariance(covariance, T_target_source)
            ends, T_target_source = (ends[1], ends[0]), T_target_source.inverse()
        source, target = self._library.window(ends[0]), self._library.window(ends[1])
        return Match(source, target, self._prior(T_target_source, covariance, ends))

    def _prior(
        self, T_target_source: SE2, covariance: FloatArray, ends: Sequence[SubmapId]
    ) -> PriorWindow:
        radius_m = max(self._library.submaps[i].radius_m for i in ends)
        half_width_m = _PRIOR_SIGMA * _sigma_m(covariance) + _PRIOR_SHARE * radius_m
        half_width_rad = _PRIOR_SIGMA * math.sqrt(float(covariance[2, 2])) + _PRIOR_RAD
        rounded = SE2.from_array(np.round(T_target_source.as_array(), 6))
        return PriorWindow(rounded, round(half_width_m, 3), round(min(half_width_rad, math.pi), 4))

    def _vote(self, answer: Answer) -> _Vote:
        return _Vote(self.joint(answer), answer.match.prior, answer.is_accepted)

    def _votes(self, replies: Sequence[Answer]) -> list[_Vote]:
        return [self._vote(reply) for reply in replies if reply.is_guess]

    def _weigh(
        self, votes: Sequence[_Vote], num_checks: int, source: Side, target: Side
    ) -> tuple[list[Joint], float]:
        """The joints to be believed, and the odds that what they say is true.

        Every check that agrees with another vote speaks for it as much as such an agreement is
        unlikely by chance: the smaller the region of agreement is within the window that was
        searched, the more. A check that was refused for want of evidence votes too, and is
        believed itself where agreement makes up for what it lacks.
        """
        edges = [self._turned(vote.joint.edge, source, target) for vote in votes]
        weights = [vote.joint.probability for vote in votes]
        probability = self._config.inlier_probability
        clique = consistent_set(edges, weights, source, target, probability)
        has_accepted = any(votes[index].is_accepted for index in clique)
        believed: list[Joint] = []
        odds = (1.0 - _PASS) ** (num_checks - sum(votes[i].prior is not None for i in clique))
        for place, index in enumerate(clique):
            vote = votes[index]
            others = [other for other in clique if other != index]
            chance = min(
                (self._chance(edges, index, o, vote, source, target) for o in others), default=1.0
            )
            lacking = 1.0 / max(vote.joint.probability, 1e-9) - 1.0
            if vote.is_accepted or lacking * chance <= 1.0 / _ENOUGH_ODDS:
                believed.append(vote.joint)
            if place > 0 and vote.prior is not None:
                odds *= _PASS / min(
                    self._chance(edges, index, earlier, vote, source, target)
                    for earlier in clique[:place]
                )
        # Without an accepted answer among them, agreement has to be beyond doubt.
        if not has_accepted and odds < _ODDS_BEYOND_DOUBT:
            return [], 0.0
        return believed, odds

    def _chance(
        self,
        edges: Sequence[Edge],
        index: int,
        other: int,
        vote: _Vote,
        source: Side,
        target: Side,
    ) -> float:
        """Share of the searched window in which a vote would agree with another one."""
        if vote.prior is None:
            return 1.0
        _, covariance = cycle_of(edges[index], edges[other], source, target)
        radius = math.sqrt(float(chi2.ppf(self._config.inlier_probability, 3)))
        sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:2, :2]), 0.0))
        sides_m = np.minimum(2.0 * radius * sigmas, 2.0 * vote.prior.half_width_m)
        turn = min(radius * math.sqrt(float(covariance[2, 2])), vote.prior.half_width_rad)
        window = 4.0 * vote.prior.half_width_m**2 * vote.prior.half_width_rad
        share = sides_m.prod() * turn / window
        return float(max(share, _LEAST_CHANCE))

    @staticmethod
    def _turned(edge: Edge, source: Side, target: Side) -> Edge:
        """The same edge, from `source` to `target`."""
        if edge.source in source.T_frame_submap and edge.target in target.T_frame_submap:
            return edge
        return edge.reversed()

    def _ask_all(self, matches: Sequence[Match]) -> list[Answer] | None:
        """All answers, or None while one is missing."""
        replies = [reply for match in matches if (reply := self.ask(match)) is not None]
        return replies if len(replies) == len(matches) else None

    def ask(self, match: Match) -> Answer | None:
        """The answer, if there is one; otherwise the question is noted as wanted."""
        units = match.source.key, match.target.key
        for earlier in self._replies.get(units, ()):
            if match.prior is not None and earlier.is_guess and earlier.is_inside(match.prior):
                return earlier
        self.visited.add(match.key)
        answer = self._answers.get(match.key)
        if answer is None:
            self.wanted.setdefault(match.key, match)
        elif match.prior is not None:
            self._replies.setdefault(units, []).append(answer)
        return answer


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """An answer as evidence; without a prior it is the claim that the others check."""

    joint: Joint
    prior: PriorWindow | None
    is_accepted: bool


def _sigma_m(covariance: FloatArray) -> float:
    """Largest standard deviation of the translation."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))


def _is_apart(one: SubmapId, other: SubmapId, num_neighbours: int) -> bool:
    return one[0] != other[0] or abs(one[1] - other[1]) > num_neighbours
