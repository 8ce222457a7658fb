"""Loop closures between a vehicle's own submaps: proposed by the graph, then judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uw_dslam_ros2.core.mapping.config import LoopConfig, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.loops.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.loops.verdict import decide_loop
from uw_dslam_ros2.core.mapping.scans.matcher import Prior
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["MIN_POINTS", "find_loops", "nearby"]

MIN_POINTS = 60
"""Submaps with fewer points than this show too little to be told from others."""


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
        answer = decide_loop(
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
