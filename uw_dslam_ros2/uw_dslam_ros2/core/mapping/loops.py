"""Loop closures between a vehicle's own submaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.matcher import LikelihoodField, Match, Prior, match_points
from uw_dslam_ros2.core.mapping.section import ClosedSection

__all__ = ["find_loops"]

FloatArray = NDArray[np.float64]
_COARSEST = 8.0


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
        match = match_sections(
            sections[target], sections[source], Prior(T_target_source, covariance), config
        )
        if match is not None and is_believed(match, config):
            graph.add_loop(target, source, match.T_target_source, match.information)
            found = True
    return graph.optimize() if found else False


def _candidates(
    graph: SubmapGraph, sections: list[ClosedSection], source: int, config: VehicleMapperConfig
) -> list[int]:
    """Earlier submaps, not the neighbour, whose points may overlap; the nearest first."""
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


def match_sections(
    target: ClosedSection, source: ClosedSection, prior: Prior, config: VehicleMapperConfig
) -> Match | None:
    """Match two submaps around a prior; None if the prior is too wide to search."""
    sigma = np.sqrt(np.diag(prior.covariance)) * config.loop.search_sigma
    fine = config.match.sigma_m
    half_width = (
        float(np.clip(sigma[0], 2.0 * fine, config.loop.max_window_m)),
        float(np.clip(sigma[1], 2.0 * fine, config.loop.max_window_m)),
        float(np.clip(sigma[2], 0.05, config.loop.max_window_rad)),
    )
    coarse = float(np.clip(max(half_width[:2]) / 8.0, fine, _COARSEST * fine))
    sigmas = [coarse]
    while sigmas[-1] > 1.5 * fine:
        sigmas.append(max(0.5 * sigmas[-1], fine))
    fields = [_field(target, s) for s in sigmas]
    points, weight = _selection(source, config.loop.max_points)
    # The window already says where to look; inside it the prior only breaks ties, so it is made
    # wide.
    wide = Prior(prior.T_target_source, prior.covariance * 4.0 + np.diag([fine**2, fine**2, 1e-4]))
    return match_points(fields, points, weight, wide, half_width, config.match.information_share)


def is_believed(match: Match, config: VehicleMapperConfig) -> bool:
    """Whether overlap and the lead over rivals suffice."""
    return match.overlap >= config.loop.min_overlap and match.lead >= config.loop.min_lead


def _field(section: ClosedSection, sigma_m: float) -> LikelihoodField:
    if section.fields is None:
        section.fields = {}
    key = round(sigma_m, 6)
    if key not in section.fields:
        section.fields[key] = LikelihoodField(section.points, section.weight, sigma_m)
    return section.fields[key]


def _selection(section: ClosedSection, max_points: int) -> tuple[FloatArray, NDArray[np.float64]]:
    """An even sample of the points; weights saturate, so that long stops do not rule."""
    stride = max(1, int(np.ceil(len(section.points) / max_points)))
    return section.points[::stride], 1.0 - np.exp(-section.weight[::stride])
