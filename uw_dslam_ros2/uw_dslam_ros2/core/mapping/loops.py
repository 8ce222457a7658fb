"""Loop closures between a vehicle's own submaps: proposed by the graph, judged by the engine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import LoopConfig, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.matcher import (
    LikelihoodField,
    Prior,
    ScanMatch,
    match_points,
    thin,
)
from uw_dslam_ros2.core.mapping.rivals import conflict, rivals, without_direction
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "MAX_WINDOW_M",
    "MAX_WINDOW_RAD",
    "MIN_OVERLAP",
    "MIN_POINTS",
    "SEARCH_SIGMA",
    "find_loops",
    "nearby",
    "with_bend",
]

FloatArray = NDArray[np.float64]

SEARCH_SIGMA = 3.0
"""Half width of the search window, in standard deviations of the graph ..."""
MAX_WINDOW_M, MAX_WINDOW_RAD = 15.0, 0.35
"""... but at most this: beyond it a wrong place is found more often than a lost one."""
MIN_POINTS = 60
"""Submaps with fewer points than this show too little to be told from others."""
MIN_OVERLAP = 0.3
"""Least share of the points that must meet the other map."""
_SURE_OVERLAP = 0.5
"""That share, where the engine finds the same pose but does not accept it."""
_MAX_POINTS = 600
# A match takes a submap as rigid; on average half of its own drift lies between its points.
_BEND_SHARE = 0.25
_DIGITS = 6
_HOPELESS = 0.15
_SURE_LEAD, _SURE_CONFLICT = 0.05, 0.1
_NEAR_RAD = 0.02
_COARSEST = 8.0
# The proof matters less than the verdict here: the window is small and many pairs are tried.
_OPEN = Verdict.NOT_ENOUGH_OVERLAP, Verdict.IMPROBABLE, Verdict.AMBIGUOUS
_REGISTRATION = GridRegistrationConfig(max_boxes=20_000)


def find_loops(
    graph: SubmapGraph, sections: list[ClosedSection], config: VehicleMapperConfig
) -> bool:
    """Match the newest closed submap with earlier ones near it; True if the graph moved."""
    source = len(sections) - 1
    if len(sections[source].points) < MIN_POINTS:
        return False
    found = False
    for target in nearby(sections, graph.poses, source, config.loop):
        T_target_source, covariance = graph.relative(target, source)
        answer = _verified(
            sections[target], sections[source], Prior(T_target_source, covariance), config
        )
        if answer is not None:
            graph.add_loop(target, source, *answer)
            found = True
    return graph.optimize() if found else False


def nearby(
    sections: Sequence[ClosedSection],
    poses: Sequence[SE2],
    source: int,
    config: LoopConfig,
    slack_m: float = 0.0,
) -> list[int]:
    """Earlier submaps, not the neighbour, whose points may overlap; the nearest first.

    ``poses`` place the submaps in one frame, to within ``slack_m``.
    """
    here = poses[source].apply(sections[source].center)
    scored = []
    for target in range(source - 1):
        if len(sections[target].points) < MIN_POINTS:
            continue
        distance = float(np.linalg.norm(poses[target].apply(sections[target].center) - here))
        reach = 0.7 * (sections[target].radius_m + sections[source].radius_m) + slack_m
        if distance < reach:
            scored.append((distance / reach, target))
    scored.sort()
    return [target for _, target in scored[: config.max_candidates]]


def _verified(
    target: ClosedSection, source: ClosedSection, prior: Prior, config: VehicleMapperConfig
) -> tuple[SE2, FloatArray] | None:
    """``T_target_source`` and its information (3, 3), in the target frame; None if refused.

    Two judges look within the window that the graph allows: the mapper's matcher at echoes, the
    registration engine at walls and free water. The engine accepts by itself; where it does not,
    but finds the same pose as a matcher that is sure, the two together are enough. Where the same
    walls would fit a period further, only what lies across the periods is believed.
    """
    fine = config.match.sigma_m
    sigma = np.sqrt(np.diag(prior.covariance)) * SEARCH_SIGMA
    half_width_m = np.clip(sigma[:2], 2.0 * fine, MAX_WINDOW_M)
    half_width_rad = float(np.clip(sigma[2], 0.05, MAX_WINDOW_RAD))
    half_width = (float(half_width_m[0]), float(half_width_m[1]), half_width_rad)
    guess = _matched(target, source, prior, half_width, config)
    if guess.overlap < _HOPELESS:
        return None
    window = PriorWindow(
        prior.T_target_source, max(float(half_width_m.max()), 4.0 * fine), half_width_rad
    )
    T_target_source = _agreed(target, source, guess, window, config)
    if T_target_source is None:
        return None
    near = Prior(T_target_source, np.diag([fine, fine, _NEAR_RAD]) ** 2)
    match = _matched(target, source, near, (4.0 * fine, 4.0 * fine, 2.0 * _NEAR_RAD), config)
    if match.overlap < MIN_OVERLAP:
        return None
    rotation = np.eye(3)
    rotation[:2, :2] = match.T_target_source.rotation()
    bend = target.drift + rotation @ source.drift @ rotation.T
    others = rivals(target, source, match.T_target_source, prior, window.half_width_m, fine)
    information = without_direction(match.information, others)
    return match.T_target_source, with_bend(information, bend)


def _agreed(
    target: ClosedSection,
    source: ClosedSection,
    guess: ScanMatch,
    window: PriorWindow,
    config: VehicleMapperConfig,
) -> SE2 | None:
    """The pose that the engine accepts, or that both judges find; None otherwise."""
    log_odds_max = config.occupancy.log_odds_max
    judged = register_grids(
        source.evidence.unpacked().to_occupancy(log_odds_max),
        target.evidence.unpacked().to_occupancy(log_odds_max),
        _REGISTRATION,
        prior=window,
    )
    found = judged.T_target_source
    if found is None:
        return None
    if judged.is_accepted and _is_within(found, window):
        # The engine's last digits depend on how memory is aligned; the mapper's must not.
        return SE2.from_array(np.round(found.as_array(), _DIGITS))
    # Whether the walls would fit elsewhere too is asked below, where the prior has its say.
    if judged.verdict not in _OPEN or not _is_sure(guess, target, source):
        return None
    distance, turn = found.distance_to(guess.T_target_source)
    is_same = distance <= 3.0 * config.match.sigma_m and turn <= _NEAR_RAD
    return guess.T_target_source if is_same else None


def _is_sure(guess: ScanMatch, target: ClosedSection, source: ClosedSection) -> bool:
    """Whether overlap, lead over other poses and the water between the walls say so."""
    if guess.overlap < _SURE_OVERLAP or guess.lead < _SURE_LEAD:
        return False
    there = conflict(target.evidence, source.points, guess.T_target_source)
    back = conflict(source.evidence, target.points, guess.T_target_source.inverse())
    return max(there, back) <= _SURE_CONFLICT


def _is_within(T_target_source: SE2, window: PriorWindow) -> bool:
    distance, turn = T_target_source.distance_to(window.T_target_source)
    return distance <= 1.5 * window.half_width_m and turn <= 1.5 * window.half_width_rad


def _matched(
    target: ClosedSection,
    source: ClosedSection,
    prior: Prior,
    half_width: tuple[float, float, float],
    config: VehicleMapperConfig,
) -> ScanMatch:
    """Match of points with points within a window, from coarse to fine."""
    fine = config.match.sigma_m
    sigmas = [float(np.clip(max(half_width[:2]) / 8.0, 2.0 * fine, _COARSEST * fine))]
    while sigmas[-1] > 1.5 * fine:
        sigmas.append(max(0.5 * sigmas[-1], fine))
    fields = [LikelihoodField(target.points, target.weight, s) for s in sigmas]
    points, weight = thin(source.points, 1.0 - np.exp(-source.weight), fine)
    stride = max(1, -(-len(points) // _MAX_POINTS))
    # The window already says where to look; inside it the prior only breaks ties, so it is wide.
    spread = prior.covariance * 4.0 + np.diag([fine**2, fine**2, 1e-4])
    return match_points(
        fields, points[::stride], weight[::stride], Prior(prior.T_target_source, spread),
        half_width, config.match.information_share,
    )  # fmt: skip


def with_bend(information: FloatArray, bend: FloatArray) -> FloatArray:
    """Information (3, 3) of a match, less what the submaps may be bent, by their drift (3, 3)."""
    # (L^-1 + B)^-1 without inverting L, which may be singular.
    return information @ np.linalg.inv(np.eye(3) + _BEND_SHARE * bend @ information)
