"""Loop closures between a vehicle's own submaps."""

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
from uw_dslam_ros2.core.mapping.occupancy import UNITS_PER_NAT, PackedEvidence
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["conflict", "find_loops"]

FloatArray = NDArray[np.float64]
_COARSEST = 8.0
_SURELY_FREE_NATS = 0.6
# A match takes a submap as rigid; on average half of its own drift lies between its points.
_BEND_SHARE = 0.25


def find_loops(
    graph: SubmapGraph, sections: list[ClosedSection], config: VehicleMapperConfig
) -> bool:
    """Match the newest closed submap with earlier ones near it; True if the graph moved."""
    source = len(sections) - 1
    if len(sections[source].points) < config.loop.min_points:
        return False
    points, weight = _surroundings(
        graph, sections, source, source - config.loop.num_context, source
    )
    stride = max(1, -(-len(points) // config.loop.max_points))
    found = False
    for target in _candidates(graph, sections, source, config):
        T_target_source, covariance = graph.relative(target, source)
        # The source's own context must not match itself.
        last = min(target + config.loop.num_context, source - config.loop.num_context - 1)
        known, support = _surroundings(
            graph, sections, target, target - config.loop.num_context, max(target, last)
        )
        prior = Prior(T_target_source, covariance)
        match = _match(known, support, points[::stride], weight[::stride], prior, config)
        if _is_believed(match, sections[target], sections[source], config):
            information = _with_bend(match, sections[target], sections[source])
            graph.add_loop(target, source, match.T_target_source, information)
            found = True
    return graph.optimize() if found else False


def _candidates(
    graph: SubmapGraph, sections: list[ClosedSection], source: int, config: VehicleMapperConfig
) -> list[int]:
    """Earlier submaps, not the neighbours, whose points may overlap; the nearest first."""
    poses = graph.poses
    here = poses[source].apply(sections[source].center)
    scored = []
    for target in range(source - 1 - config.loop.num_context):
        if len(sections[target].points) < config.loop.min_points:
            continue
        distance = float(np.linalg.norm(poses[target].apply(sections[target].center) - here))
        reach = 0.7 * (sections[target].radius_m + sections[source].radius_m)
        if distance < reach:
            scored.append((distance / reach, target))
    scored.sort()
    return [target for _, target in scored[: config.loop.max_candidates]]


def _surroundings(
    graph: SubmapGraph, sections: list[ClosedSection], center: int, first: int, last: int
) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) and weights of submaps first to last in the frame of `center`.

    One short submap often fits in several places; with its neighbours it is distinct.
    """
    poses = graph.poses
    points, weight = [], []
    for index in range(max(first, 0), min(last, len(sections) - 1) + 1):
        T_center_here = poses[center].inverse() @ poses[index]
        points.append(T_center_here.apply(sections[index].points))
        weight.append(sections[index].weight)
    return np.vstack(points), np.concatenate(weight)


def _match(
    known: FloatArray,
    support: FloatArray,
    points: FloatArray,
    weight: FloatArray,
    prior: Prior,
    config: VehicleMapperConfig,
) -> Match:
    """Match points against known ones in a window around a prior."""
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
    fields = [LikelihoodField(known, support, s) for s in sigmas]
    # The window already says where to look; inside it the prior only breaks ties, so it is wide.
    spread = prior.covariance * 4.0 + np.diag([fine**2, fine**2, 1e-4])
    source, source_weight = thin(points, 1.0 - np.exp(-weight), fine)
    return match_points(
        fields, source, source_weight, Prior(prior.T_target_source, spread), half_width,
        config.match.information_share,
    )  # fmt: skip


def _with_bend(match: Match, target: ClosedSection, source: ClosedSection) -> FloatArray:
    """Information (3, 3) of a match, less what the two submaps may be bent."""
    rotation = np.eye(3)
    rotation[:2, :2] = match.T_target_source.rotation()
    bend = target.drift + rotation @ source.drift @ rotation.T
    # (L^-1 + B)^-1 without inverting L, which may be singular.
    information = match.information
    return information @ np.linalg.inv(np.eye(3) + _BEND_SHARE * bend @ information)


def _is_believed(
    match: Match, target: ClosedSection, source: ClosedSection, config: VehicleMapperConfig
) -> bool:
    """Whether overlap, lead over rivals and the water between the walls allow it."""
    if match.overlap < config.loop.min_overlap or match.lead < config.loop.min_lead:
        return False
    there = conflict(target.evidence, source.points, match.T_target_source)
    back = conflict(source.evidence, target.points, match.T_target_source.inverse())
    return max(there, back) <= config.loop.max_conflict


def conflict(evidence: PackedEvidence, points: FloatArray, T_grid_points: SE2) -> float:
    """Share of the points (N, 2) that fall on surely free water of a grid."""
    if len(points) == 0:
        return 0.0
    grid = evidence.unpacked()
    cells = np.floor(T_grid_points.apply(points) / grid.resolution_m).astype(np.int64)
    rows, cols = cells[:, 1] - grid.row, cells[:, 0] - grid.col
    inside = (rows >= 0) & (cols >= 0)
    inside &= (rows < grid.evidence.shape[0]) & (cols < grid.evidence.shape[1])
    free = grid.evidence[rows[inside], cols[inside]] < -_SURELY_FREE_NATS * UNITS_PER_NAT
    return float(free.sum()) / len(points)
