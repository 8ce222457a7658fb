"""Is a match true? Ask again where it would have to show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.submap import SubmapId
from uw_dslam_ros2.core.merging.answers import Answer, Match, MatchKey
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.consistency import Side, consistent_set
from uw_dslam_ros2.core.merging.graph import Edge, compose_covariance
from uw_dslam_ros2.core.merging.library import Library
from uw_dslam_ros2.core.merging.settling import Joint
from uw_dslam_ros2.core.merging.units import Unit
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Verifier"]

FloatArray = NDArray[np.float64]

_MIN_SHARE = 0.25
"""Least common area of two submaps, as a share of the smaller, that is worth a check."""
_NUM_ROUNDS = 2
"""Where the first checks leave it open, as many again are asked at other places."""
_CONFIRMED, _ENOUGH = 3, 4
"""A check that agrees counts three, one that does not minus one; with four the match is believed.
A single check that can be asked has to agree.

About the logarithms of the likelihood ratios, if a true match passes two checks in three and a
false one passes one in twenty.
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

    def joints_of(self, match: Match, source: Side, target: Side) -> list[Joint]:
        """Joints that a match and its checks make; none while an answer is missing.

        Parameters
        ----------
        match
            The question, without a prior.
        source, target
            All that the two maps belong to.
        """
        answer = self._ask(match)
        if answer is None or not answer.is_accepted:
            return []
        main = self.joint(answer)
        T_target_source = (
            target.T_frame_submap[main.edge.target]
            @ main.edge.T_target_source
            @ source.T_frame_submap[main.edge.source].inverse()
        )
        checks = self._checks(match, main.edge, T_target_source, source, target)
        if not checks:
            # Two single submaps are all there is to ask about; otherwise they would have met.
            return [main] if len(match.source.ids) == len(match.target.ids) == 1 else []
        for count in range(
            self._config.max_checks, len(checks) + self._config.max_checks, self._config.max_checks
        ):
            replies = self._ask_all(checks[:count])
            if replies is None:
                return []
            confirming = [self.joint(reply) for reply in replies if reply.is_accepted]
            joints = self._consistent([main, *confirming], source, target)
            num_confirmed = len(joints) - 1
            enough = min(_ENOUGH, _CONFIRMED * len(checks))
            if _CONFIRMED * num_confirmed - (len(replies) - num_confirmed) >= enough:
                return joints
        return []

    def joints_nearby(self, source: Side, target: Side) -> list[Joint]:
        """Joints between two vehicles of one component, where the graph says that they meet."""
        checks = self._checks(None, None, SE2(), source, target)[: self._config.max_checks]
        replies = self._ask_all(checks)
        if replies is None:
            return []
        accepted = [self.joint(reply) for reply in replies if reply.is_accepted]
        return self._consistent(accepted, source, target)

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
            if (
                match is not None
                and match.source.ids == units[0].ids
                and (match.target.ids == units[1].ids)
            ):
                continue  # the same maps once more would confirm themselves
            T_between = (
                target.T_frame_submap[target_id].inverse()
                @ T_target_source
                @ source.T_frame_submap[source_id]
            )
            ends = (source_id, target_id)
            uncertainty = self._uncertainty(main, ends, source, target)
            checks.append(Match(*units, self._prior(T_between, uncertainty, ends)))
        return checks

    def _meetings(
        self, T_target_source: SE2, source: Side, target: Side
    ) -> list[tuple[SubmapId, SubmapId]]:
        submaps = self._library.submaps
        areas: list[tuple[float, SubmapId, SubmapId]] = []
        for source_id, T_source in source.T_frame_submap.items():
            T_there = T_target_source @ T_source
            for target_id, T_target in target.T_frame_submap.items():
                T_between = T_target.inverse() @ T_there
                area = self._library.shared_area_m2(source_id, target_id, T_between)
                smaller = min(submaps[source_id].area_m2, submaps[target_id].area_m2)
                if area >= _MIN_SHARE * smaller:
                    areas.append((area, source_id, target_id))
        areas.sort(key=lambda item: (-item[0], item[1], item[2]))
        return self._spaced([(source_id, target_id) for _, source_id, target_id in areas])

    def _spaced(
        self, pairs: Sequence[tuple[SubmapId, SubmapId]]
    ) -> list[tuple[SubmapId, SubmapId]]:
        """First those with no submap in common, then the others; as many as may be asked."""
        reach = 2 * self._config.num_neighbours
        chosen: list[tuple[SubmapId, SubmapId]] = []
        for pair in pairs:
            if all(
                _is_apart(pair[0], s, reach) or _is_apart(pair[1], t, reach) for s, t in chosen
            ):
                chosen.append(pair)
        rest = [pair for pair in pairs if pair not in chosen]
        return [*chosen, *rest][: _NUM_ROUNDS * self._config.max_checks]

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

    def _prior(
        self, T_target_source: SE2, covariance: FloatArray, ends: Sequence[SubmapId]
    ) -> PriorWindow:
        radius_m = max(self._library.submaps[i].radius_m for i in ends)
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        half_width_m = _PRIOR_SIGMA * sigma_m + _PRIOR_SHARE * radius_m
        half_width_rad = _PRIOR_SIGMA * math.sqrt(float(covariance[2, 2])) + _PRIOR_RAD
        rounded = SE2.from_array(np.round(T_target_source.as_array(), 6))
        return PriorWindow(rounded, round(half_width_m, 3), round(min(half_width_rad, math.pi), 4))

    def _consistent(self, joints: Sequence[Joint], source: Side, target: Side) -> list[Joint]:
        chosen = consistent_set(
            [joint.edge for joint in joints],
            [joint.probability for joint in joints],
            source,
            target,
            self._config.inlier_probability,
        )
        return [joints[index] for index in chosen]

    def _ask_all(self, matches: Sequence[Match]) -> list[Answer] | None:
        """All answers, or None while one is missing."""
        replies = [reply for match in matches if (reply := self._ask(match)) is not None]
        return replies if len(replies) == len(matches) else None

    def _ask(self, match: Match) -> Answer | None:
        self.visited.add(match.key)
        answer = self._answers.get(match.key)
        if answer is None:
            self.wanted.setdefault(match.key, match)
        return answer


def _is_apart(one: SubmapId, other: SubmapId, num_neighbours: int) -> bool:
    return one[0] != other[0] or abs(one[1] - other[1]) > num_neighbours
