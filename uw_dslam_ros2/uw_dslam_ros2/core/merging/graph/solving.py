"""From edges to components: which submaps hang together, and their poses."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import networkx as nx

from uw_dslam_ros2.core.merging.graph.components import Component, Constraint, LoopError
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import solve_graph
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["loop_errors", "solve_components"]


def solve_components(
    submaps: Iterable[SubmapId],
    anchor: SubmapId,
    odometry: Sequence[Edge],
    constraints: Sequence[Constraint],
    inlier_probability: float,
) -> tuple[list[Constraint], list[Component]]:
    """Solve the graph of each connected group, leaving out the constraints that disagree.

    Returns
    -------
    tuple
        All constraints, by key, with what became of them; and the components, the anchor's first
        (in its frame), then by smallest submap (in that one's frame).
    """
    ids = sorted(submaps)
    ordered = sorted(constraints, key=lambda constraint: constraint.key)
    is_inlier = {constraint.key: True for constraint in ordered}
    while True:
        used = [constraint for constraint in ordered if is_inlier[constraint.key]]
        components, num_dropped = [], 0
        for group in _groups(ids, anchor, [*odometry, *(constraint.edge for constraint in used)]):
            firm = [edge for edge in odometry if edge.source in group]
            here = [constraint for constraint in used if constraint.edge.source in group]
            root = anchor if anchor in group else min(group)
            initial = _spread(root, firm, here)
            edges = [constraint.edge for constraint in here]
            solution = solve_graph(root, firm, edges, initial, inlier_probability)
            for constraint, agrees in zip(here, solution.is_inlier, strict=True):
                if not agrees:
                    is_inlier[constraint.key] = False
                    num_dropped += 1
            components.append(solution.T_anchor_pose)
        if num_dropped == 0:
            solved = [
                replace(constraint, is_inlier=is_inlier[constraint.key]) for constraint in ordered
            ]
            return solved, components


def loop_errors(odometry: Sequence[Edge], constraints: Sequence[Constraint]) -> list[LoopError]:
    """Cycles of at least three submaps: one for each edge beyond a spanning tree.

    The tree takes odometry first, then the most probable constraints.
    """
    graph = _constraint_graph(odometry, constraints)
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


def _constraint_graph(firm: Sequence[Edge], constraints: Sequence[Constraint]) -> nx.Graph:
    graph = nx.Graph()
    for edge in firm:
        graph.add_edge(edge.source, edge.target, cost=0.0, edge=edge)
    for constraint in constraints:
        ends = constraint.edge.source, constraint.edge.target
        cost = 1.0 - constraint.probability + 1e-3
        if not graph.has_edge(*ends) or graph.edges[ends]["cost"] > cost:
            graph.add_edge(*ends, cost=cost, edge=constraint.edge)
    return graph


def _spread(
    root: SubmapId, firm: Sequence[Edge], constraints: Sequence[Constraint]
) -> Mapping[SubmapId, SE2]:
    """First guess of all poses: along odometry, and over the most probable constraints."""
    graph = _constraint_graph(firm, constraints)
    graph.add_node(root)
    tree = nx.minimum_spanning_tree(graph, weight="cost")
    poses = {root: SE2()}
    for known, new in nx.bfs_edges(tree, root, sort_neighbors=sorted):
        poses[new] = poses[known] @ _step(tree, known, new)
    return poses
