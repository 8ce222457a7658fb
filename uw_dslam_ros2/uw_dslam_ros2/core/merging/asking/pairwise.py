"""The paper's queue of maps, plainly: take two, register them, put the merged one back.

Zhang et al. 2023, Algorithm 1: no checks, no graph, and nothing is taken back. For comparison.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.checks.verification import Verifier
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Component, Constraint
from uw_dslam_ros2.core.merging.graph.consistency import Side
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["make_pairwise_plan"]


def make_pairwise_plan(
    library: Library,
    tracks: Sequence[Track],
    answers: Mapping[QueryKey, Answer],
    anchor: SubmapId,
    *,
    is_growing: bool = False,
) -> Plan:
    """Merge the tracks' maps in the order given, and say which question is open.

    The first map of the queue is matched with the next one. A merged map goes to the end; a map
    that matches no other goes there too, and is tried again with what has been merged meanwhile.

    Parameters
    ----------
    library
        The submaps; each track's are one map by its own odometry.
    tracks
        In order of arrival.
    answers
        By the key of the question.
    anchor
        The submap that the global frame is pinned to.
    is_growing
        More submaps are expected: match each track's first 1, 2, 4, 8, ... submaps, so that not
        each new one asks everything anew.
    """
    verifier = Verifier(library, answers)
    queue = [_track_map(library, track) for track in tracks]
    idle = [c for c in queue if not library.component_side(c).T_frame_submap]
    queue = [component for component in queue if component not in idle]
    refused: set[frozenset[bytes]] = set()
    constraints: list[Constraint] = []
    num_refused = 0
    while len(queue) > 1 and num_refused < len(queue):
        first, rest = queue[0], queue[1:]
        groups = [_group(library, component, is_growing) for component in (first, *rest)]
        merged = _merge_first(verifier, first, rest, groups, constraints, refused)
        if verifier.wanted:
            break
        if merged is None:
            queue, num_refused = [*rest, first], num_refused + 1
        else:
            index, component = merged
            queue, num_refused = [*rest[:index], *rest[index + 1 :], component], 0
    components = [_anchored(component, anchor) for component in (*queue, *idle)]
    components.sort(key=lambda component: (anchor not in component, min(component)))
    wanted = list(verifier.wanted.values())
    return Plan(wanted, constraints, library.odometry.edges, components)


def _track_map(library: Library, track: Track) -> Component:
    ids = sorted(submap_id for submap_id in library.submaps if submap_id.track == track)
    T_first_odom = library.odometry.T_odom_submap(ids[0]).inverse()
    return {i: T_first_odom @ library.odometry.T_odom_submap(i) for i in ids}


def _group(library: Library, component: Component, is_growing: bool) -> SubmapGroup:
    """What is matched of a map: all, or the first 1, 2, 4, 8, ... submaps of each track."""
    side = library.component_side(component)
    if is_growing:
        members: dict[Track, list[SubmapId]] = {}
        for submap_id in sorted(side.T_frame_submap):
            members.setdefault(submap_id.track, []).append(submap_id)
        begun = [i for ids in members.values() for i in ids[: 1 << (len(ids).bit_length() - 1)]]
        side = Side({i: side.T_frame_submap[i] for i in begun}, side.covariances)
    return library.component_group(side)


def _merge_first(
    verifier: Verifier,
    first: Component,
    rest: Sequence[Component],
    groups: Sequence[SubmapGroup],
    constraints: list[Constraint],
    refused: set[frozenset[bytes]],
) -> tuple[int, Component] | None:
    """Index of the map that the first one was merged with, and the merged map."""
    target = groups[0]
    for index, (other, source) in enumerate(zip(rest, groups[1:], strict=True)):
        pair = frozenset((source.key, target.key))
        if pair in refused:
            continue  # asked the other way round
        answer = verifier.ask(Query(source, target))
        if answer is None:
            return None
        refused.add(pair)
        if answer.is_accepted:
            assert answer.T_target_source is not None
            constraints.append(verifier.constraint(answer))
            T_first_other = (
                first[target.reference]
                @ answer.T_target_source
                @ other[source.reference].inverse()
            )
            return index, first | {i: T_first_other @ T for i, T in other.items()}
    return None


def _anchored(component: Component, anchor: SubmapId) -> Component:
    root = anchor if anchor in component else min(component)
    T_root_frame = component[root].inverse()
    return {i: SE2() if i == root else T_root_frame @ T for i, T in component.items()}
