"""From edges to components: groups of submaps that hang together, and their poses."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import networkx as nx

from uw_dslam_ros2.core.merging.answers import MatchKey
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import solve_graph
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Component", "Joint", "LoopError", "loop_errors", "settle"]

Component = dict[SubmapId, SE2]
"""``T_component_submap``."""


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """An accepted registration in the graph."""

    key: MatchKey
    edge: Edge
    probability: float
    is_inlier: bool = True
    is_unsure: bool = False
    """Refused by itself; believed because others agree with it."""


@dataclass(frozen=True, slots=True)
class LoopError:
    """By how much a cycle of edges fails to close: as measured, nothing optimised."""

    submaps: tuple[SubmapId, ...]
    error_m: float
    error_rad: float


def settle(
    submaps: Iterable[SubmapId],
    anchor: SubmapId,
    odometry: Sequence[Edge],
    joints: Sequence[Joint],
    inlier_probability: float,
) -> tuple[list[Joint], list[Component]]:
    """Solve the graph of each connected group, leaving out the joints that disagree.

    Returns
    -------
    tuple
        All joints, by key, with what became of them; and the components, the anchor's first (in
        its frame), then by smallest submap (in that one's frame).
    """
    ids = sorted(submaps)
    ordered = sorted(joints, key=lambda joint: joint.key)
    is_inlier = {joint.key: True for joint in ordered}
    while True:
        used = [joint for joint in ordered if is_inlier[joint.key]]
        components, num_dropped = [], 0
        for group in _groups(ids, anchor, [*odometry, *(joint.edge for joint in used)]):
            firm = [edge for edge in odometry if edge.source in group]
            here = [joint for joint in used if joint.edge.source in group]
            root = anchor if anchor in group else min(group)
            initial = _spread(root, firm, here)
            edges = [joint.edge for joint in here]
            solution = solve_graph(root, firm, edges, initial, inlier_probability)
            for joint, agrees in zip(here, solution.is_inlier, strict=True):
                if not agrees:
                    is_inlier[joint.key] = False
                    num_dropped += 1
            components.append(solution.T_anchor_pose)
        if num_dropped == 0:
            settled = [replace(joint, is_inlier=is_inlier[joint.key]) for joint in ordered]
            return settled, components


def loop_errors(odometry: Sequence[Edge], joints: Sequence[Joint]) -> list[LoopError]:
    """Cycles of at least three submaps: one for each edge beyond a spanning tree.

    The tree takes odometry first, then the most probable joints.
    """
    graph = _joint_graph(odometry, joints)
    tree = nx.minimum_spanning_tree(graph, weight="cost")
    errors: list[LoopError] = []
    for start, end in sorted(tuple(sorted(ends)) for ends in graph.edges):
        if tree.has_edge(start, end):
            continue
        path = nx.shortest_path(tree, start, end)
        closed = _step(graph, end, start)
        for here, there in itertools.pairwise(path):
            closed = closed @ _step(graph, here, there)
        errors.append(LoopError(tuple(path), *closed.distance_to(SE2())))
    return errors


def _step(graph: nx.Graph, here: SubmapId, there: SubmapId) -> SE2:
    """``T_here_there`` as measured."""
    edge: Edge = graph.edges[here, there]["edge"]
    motion = edge.T_target_source
    return motion if edge.source == there else motion.inverse()


def _groups(
    ids: Sequence[SubmapId], anchor: SubmapId, edges: Iterable[Edge]
) -> list[set[SubmapId]]:
    graph = nx.Graph()
    graph.add_nodes_from(ids)
    graph.add_edges_from((edge.source, edge.target) for edge in edges)
    groups = list(nx.connected_components(graph))
    return sorted(groups, key=lambda group: (anchor not in group, min(group)))


def _joint_graph(firm: Sequence[Edge], joints: Sequence[Joint]) -> nx.Graph:
    graph = nx.Graph()
    for edge in firm:
        graph.add_edge(edge.source, edge.target, cost=0.0, edge=edge)
    for joint in joints:
        ends = joint.edge.source, joint.edge.target
        cost = 1.0 - joint.probability + 1e-3
        if not graph.has_edge(*ends) or graph.edges[ends]["cost"] > cost:
            graph.add_edge(*ends, cost=cost, edge=joint.edge)
    return graph


def _spread(
    root: SubmapId, firm: Sequence[Edge], joints: Sequence[Joint]
) -> Mapping[SubmapId, SE2]:
    """First guess of all poses: along odometry, and over the most probable joints."""
    graph = _joint_graph(firm, joints)
    graph.add_node(root)
    tree = nx.minimum_spanning_tree(graph, weight="cost")
    poses = {root: SE2()}
    for known, new in nx.bfs_edges(tree, root, sort_neighbors=sorted):
        poses[new] = poses[known] @ _step(tree, known, new)
    return poses
