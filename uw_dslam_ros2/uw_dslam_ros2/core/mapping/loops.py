"""Loop closures between a vehicle's own submaps: proposed by the graph, judged by the engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.matcher import (
    LikelihoodField,
    Match,
    Prior,
    match_points,
    thin,
)
from uw_dslam_ros2.core.mapping.rivals import has_rival
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.registration.grids import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["find_loops", "with_bend"]

FloatArray = NDArray[np.float64]
# A match takes a submap as rigid; on average half of its own drift lies between its points.
_BEND_SHARE = 0.25
# The proof matters less than the verdict here: the window is small and many pairs are tried.
_DIGITS = 6
_REGISTRATION = GridRegistrationConfig(max_boxes=20_000)


def find_loops(
    graph: SubmapGraph, sections: list[ClosedSection], config: VehicleMapperConfig
) -> bool:
    """Match the newest closed submap with earlier ones near it; True if the graph moved."""
    source = len(sections) - 1
    if len(sections[source].points) < config.loop.min_points:
        return False
    found = False
    for target in _candidates(graph, sections, source, config):
        T_target_source, covariance = graph.relative(target, source)
        answer = _verified(
            sections[target], sections[source], Prior(T_target_source, covariance), config
        )
        if answer is not None:
            graph.add_loop(target, source, *answer)
            found = True
    return graph.optimize() if found else False


def _candidates(
    graph: SubmapGraph, sections: list[ClosedSection], source: int, config: VehicleMapperConfig
) -> list[int]:
    """Earlier submaps, not the neighbours, whose points may overlap; the nearest first."""
    poses = graph.poses
    here = poses[source].apply(sections[source].center)
    scored = []
    for target in range(source - 1):
        if len(sections[target].points) < config.loop.min_points:
            continue
        distance = float(np.linalg.norm(poses[target].apply(sections[target].center) - here))
        reach = 0.7 * (sections[target].radius_m + sections[source].radius_m)
        if distance < reach:
            scored.append((distance / reach, target))
    scored.sort()
    return [target for _, target in scored[: config.loop.max_candidates]]


def _verified(
    target: ClosedSection, source: ClosedSection, prior: Prior, config: VehicleMapperConfig
) -> tuple[SE2, FloatArray] | None:
    """``T_target_source`` and its information (3, 3), in the target frame; None if refused.

    The registration engine compares walls and free water within the window that the graph
    allows; where the same walls would fit a period further, nothing is believed. The mapper's
    own matcher, which knows points and not cells, then refines the pose.
    """
    loop = config.loop
    sigma = np.sqrt(np.diag(prior.covariance)) * loop.search_sigma
    fine = config.match.sigma_m
    window = PriorWindow(
        prior.T_target_source,
        float(np.clip(sigma[:2].max(), 4.0 * fine, loop.max_window_m)),
        float(np.clip(sigma[2], 0.05, loop.max_window_rad)),
    )
    log_odds_max = config.occupancy.log_odds_max
    judged = register_grids(
        source.evidence.unpacked().to_occupancy(log_odds_max),
        target.evidence.unpacked().to_occupancy(log_odds_max),
        _REGISTRATION,
        prior=window,
    )
    if not (judged.is_accepted and _is_within(judged.T_target_source, window)):
        return None
    if has_rival(target, source, judged.T_target_source, prior, window.half_width_m, fine):
        return None
    # The engine's last digits depend on how memory is aligned; the mapper's must not.
    T_target_source = SE2.from_array(np.round(judged.T_target_source.as_array(), _DIGITS))
    covariance = np.round(judged.covariance, _DIGITS) + np.diag([fine**2, fine**2, 1e-5])
    match = _refined(target, source, Prior(T_target_source, covariance), config)
    information = np.linalg.inv(covariance)
    if match.overlap >= loop.min_overlap:
        T_target_source, information = match.T_target_source, match.information
    rotation = np.eye(3)
    rotation[:2, :2] = T_target_source.rotation()
    bend = target.drift + rotation @ source.drift @ rotation.T
    return T_target_source, with_bend(information, bend)


def _is_within(T_target_source: SE2, window: PriorWindow) -> bool:
    distance, turn = T_target_source.distance_to(window.T_target_source)
    return distance <= 1.5 * window.half_width_m and turn <= 1.5 * window.half_width_rad


def _refined(
    target: ClosedSection, source: ClosedSection, prior: Prior, config: VehicleMapperConfig
) -> Match:
    """Match of the points near a pose that is known to some decimetres."""
    fine = config.match.sigma_m
    fields = [LikelihoodField(target.points, target.weight, s) for s in (2.0 * fine, fine)]
    points, weight = thin(source.points, 1.0 - np.exp(-source.weight), fine)
    stride = max(1, -(-len(points) // config.loop.max_points))
    return match_points(
        fields, points[::stride], weight[::stride], prior, (4.0 * fine, 4.0 * fine, 0.03),
        config.match.information_share,
    )  # fmt: skip


def with_bend(information: FloatArray, bend: FloatArray) -> FloatArray:
    """Information (3, 3) of a match, less what the submaps may be bent, by their drift (3, 3)."""
    # (L^-1 + B)^-1 without inverting L, which may be singular.
    return information @ np.linalg.inv(np.eye(3) + _BEND_SHARE * bend @ information)
