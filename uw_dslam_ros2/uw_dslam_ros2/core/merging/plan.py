"""What is to be asked, and what follows from the answers.

A plan depends on the submaps and the answers alone, and not on the order in which they came: it
is worked out anew after each change, and what has been answered before is not asked again. So a
queue that was fed in any order comes to the same map, and one that was interrupted goes on where
it was.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np

from uw_dslam_ros2.core.mapping.submap import SubmapId
from uw_dslam_ros2.core.merging.answers import Answer, Match, MatchKey, edge_of
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.graph import Edge, solve_graph
from uw_dslam_ros2.core.merging.units import StoredSubmap, Unit
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Joint", "Plan", "make_plan", "odometry_edges"]


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """An accepted registration in the graph."""

    key: MatchKey
    edge: Edge
    probability: float
    is_inlier: bool


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Where everything is, as far as is known, and what to ask next."""

    wanted: list[Match]
    joints: list[Joint]
    odometry: list[Edge]
    components: list[dict[SubmapId, SE2]]
    """``T_component_submap``; the anchor's component first, then by smallest submap."""


def odometry_edges(submaps: Mapping[SubmapId, StoredSubmap]) -> list[Edge]:
    """Edges between each vehicle's consecutive submaps, the later one as source."""
    edges: list[Edge] = []
    ids = sorted(submaps)
    for before, after in itertools.pairwise(ids):
        if before[0] != after[0]:
            continue
        earlier, later = submaps[before].submap, submaps[after].submap
        T_before_after = earlier.T_odom_submap.inverse() @ later.T_odom_submap
        turn = np.eye(3)
        turn[:2, :2] = earlier.T_odom_submap.rotation().T
        # Submaps missing in between count as much as the one that is there.
        covariance = turn @ later.covariance @ turn.T * (after[1] - before[1])
        edges.append(Edge(after, before, T_before_after, covariance))
    return edges


def make_plan(
    submaps: Mapping[SubmapId, StoredSubmap],
    withdrawn: frozenset[SubmapId],
    anchor: SubmapId,
    answers: Mapping[MatchKey, Answer],
    config: MapQueueConfig,
) -> Plan:
    """Work out the plan.

    Parameters
    ----------
    submaps
        All that are known. Withdrawn ones still carry their vehicle's odometry.
    withdrawn
        Those that are neither matched nor drawn.
    anchor
        The submap that the global frame is pinned to.
    answers
        By the key of the question.
    """
    odometry = odometry_edges(submaps)
    units = _whole_units(submaps, withdrawn)
    wanted: list[Match] = []
    joints: list[Joint] = []
    vehicles = sorted(units)
    for index, target in enumerate(vehicles):
        for source in vehicles[index + 1 :]:
            match = Match(units[source], units[target])
            answer = answers.get(match.key)
            if answer is None:
                wanted.append(match)
            elif answer.is_accepted:
                joints.append(_joint(match.key, answer, submaps, config))
    joints, components = settle(submaps, anchor, odometry, joints, config)
    return Plan(wanted, joints, odometry, components)


def settle(
    submaps: Mapping[SubmapId, StoredSubmap],
    anchor: SubmapId,
    odometry: list[Edge],
    joints: list[Joint],
    config: MapQueueConfig,
) -> tuple[list[Joint], list[dict[SubmapId, SE2]]]:
    """Solve the graph of each connected group, leaving out the edges that disagree."""
    ordered = sorted(joints, key=lambda joint: joint.key)
    is_inlier = {joint.key: True for joint in ordered}
    while True:
        used = [joint for joint in ordered if is_inlier[joint.key]]
        groups = _groups(submaps, odometry, [joint.edge for joint in used])
        groups.sort(key=lambda group: (anchor not in group, min(group)))
        components, num_dropped = [], 0
        for group in groups:
            firm = [edge for edge in odometry if edge.source in group]
            here = [joint for joint in used if joint.edge.source in group]
            root = anchor if anchor in group else min(group)
            initial = _spread(root, firm, here)
            solution = solve_graph(
                root, firm, [j.edge for j in here], initial, config.inlier_probability
            )
            for joint, agrees in zip(here, solution.is_inlier, strict=True):
                if not agrees:
                    is_inlier[joint.key] = False
                    num_dropped += 1
            components.append(solution.T_anchor_submap)
        if num_dropped == 0:
            return [
                Joint(j.key, j.edge, j.probability, is_inlier[j.key]) for j in ordered
            ], components


def _joint(
    key: MatchKey,
    answer: Answer,
    submaps: Mapping[SubmapId, StoredSubmap],
    config: MapQueueConfig,
) -> Joint:
    edge = edge_of(answer, dict(submaps), config.edge_sigma_floor_m, config.edge_sigma_floor_rad)
    return Joint(key, edge, answer.probability, True)


def _whole_units(
    submaps: Mapping[SubmapId, StoredSubmap], withdrawn: frozenset[SubmapId]
) -> dict[str, Unit]:
    members: dict[str, list[StoredSubmap]] = {}
    for submap_id in sorted(submaps):
        stored = submaps[submap_id]
        if submap_id not in withdrawn and len(stored.footprint):
            members.setdefault(submap_id[0], []).append(stored)
    return {
        vehicle: Unit.of(stored, [s.submap.T_odom_submap for s in stored], len(stored) // 2)
        for vehicle, stored in members.items()
    }


def _groups(
    submaps: Mapping[SubmapId, StoredSubmap], odometry: list[Edge], edges: list[Edge]
) -> list[set[SubmapId]]:
    graph = nx.Graph()
    graph.add_nodes_from(submaps)
    graph.add_edges_from((edge.source, edge.target) for edge in (*odometry, *edges))
    return list(nx.connected_components(graph))


def _spread(root: SubmapId, firm: list[Edge], joints: list[Joint]) -> dict[SubmapId, SE2]:
    """First guess of all poses: along odometry, and over the most probable joints."""
    graph = nx.Graph()
    graph.add_node(root)
    for edge in firm:
        graph.add_edge(edge.source, edge.target, cost=0.0, edge=edge)
    for joint in joints:
        ends = joint.edge.source, joint.edge.target
        cost = 1.0 - joint.probability + 1e-3
        if not graph.has_edge(*ends) or graph.edges[ends]["cost"] > cost:
            graph.add_edge(*ends, cost=cost, edge=joint.edge)
    tree = nx.minimum_spanning_tree(graph, weight="cost")
    poses = {root: SE2()}
    for known, new in nx.bfs_edges(tree, root, sort_neighbors=sorted):
        edge = tree.edges[known, new]["edge"]
        if edge.source == new:
            poses[new] = poses[known] @ edge.T_target_source
        else:
            poses[new] = poses[known] @ edge.T_target_source.inverse()
    return poses
