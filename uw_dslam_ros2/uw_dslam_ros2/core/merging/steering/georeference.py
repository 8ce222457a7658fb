"""Where maps lie on earth, as fixes say; and how fixes pull a pose graph that has drifted.

The place of the earth in a graph is one more pose, which is solved with all others: a fix is an
edge between it and a point of a submap. So one fix alone, with a heading or without, bends
nothing; two or more do, by as much as they are surer than odometry and matches.

Which fixes are wrong is not to be seen from what is left of them: a graph bends a long way before
a fix at its end is off. So each is held against what all others say there, with the covariance of
both (Baarda 1968), and those that agree are gathered from the two on that most others lie near.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.components import Component
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import Edge as AnyEdge
from uw_dslam_ros2.core.pose_graph import Marginals, solve_graph
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Fix", "FixFit", "Georeference", "pulled_by_fixes"]

FloatArray = NDArray[np.float64]
_Node = SubmapId | int
"""Poses that are solved: of submaps, of the earth, and of each fix's point, by its index."""

_EARTH = -1
_MIN_APART_M = 1.0
"""Positions nearer to each other than this say nothing of the map's heading."""
_MAX_STARTS = 40
"""Fixes that are paired for a first guess; more of them make it no better."""
_MAX_TRIES = 5
"""First guesses that are followed up."""
_NO_IDEA_RAD = 1e3
"""Standard deviation in place of an infinite one, which has no inverse that adds up."""
_PROBABILITY = 0.999
"""Share of right fixes that the test of each one keeps; usual in geodesy."""
_LEAST_SHARE = 1e-3
"""Of a fix's variance that others must control, for it to be tested along a direction."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A point of a submap lies at a place on earth, as a person or an instrument says."""

    submap_id: SubmapId
    point: tuple[float, float]
    """[m] in the submap's frame."""
    place: SE2
    """Where it lies in `earth_frame`, and the yaw of the submap's frame there."""
    sigma_m: float
    """Standard deviation in x and y each."""
    sigma_rad: float
    """The same of the yaw; infinite where nothing is said of it."""
    earth_frame: str
    number: int = 0
    """Of the person's decision; 0: an instrument says so."""


@dataclass(frozen=True, slots=True)
class FixFit:
    """How far off a fix is, in metres and in its own standard deviations."""

    fix: Fix
    metres_off: float
    sigmas_off: float
    is_used: bool
    """False: what else is known contradicts it, and it does not count."""


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where a map lies on earth, and by which fixes."""

    earth_frame: str
    T_earth_map: SE2
    fits: tuple[FixFit, ...]


def pulled_by_fixes(
    component: Component, edges: Sequence[Edge], fixes: Sequence[Fix]
) -> tuple[Component, Georeference | str]:
    """Solve a graph with its fixes, and say where it lies on earth.

    Parameters
    ----------
    component
        Poses as they are without fixes, those of one connected group; one of them is none.
    edges
        All that hold in the graph: they are not given up for a fix. Without any the group is
        taken as rigid.
    fixes
        Those of submaps that are not in the group do not count. What contradicts the rest by more
        than chance does not count either.

    Returns
    -------
    tuple
        The poses, in the same frame, and the place on earth; a sentence where the fixes do not
        say it, and the poses are as before.
    """
    used = [fix for fix in fixes if fix.submap_id in component]
    if not used:
        return component, "no fix of a submap that is in the map"
    frames = sorted({fix.earth_frame for fix in used})
    if len(frames) > 1:
        return component, f"the fixes are in {' and in '.join(frames)}, expected one of them"
    starts = _starts(used, component)
    if not starts:
        return component, "one more fix, elsewhere in the map, is needed, or one with a heading"
    best: tuple[list[int], Component, SE2] = [], component, starts[0].T_earth_map
    if len(used) > 1:
        pull = _Pull(component, edges, used)
        for start in starts[:_MAX_TRIES]:
            found = pull.gathered(start)
            if len(found[0]) > max(1, len(best[0])):
                best = found
            # Of many, most are enough; of few, each one counts.
            if len(best[0]) > (0.5 if len(used) > _MAX_STARTS else 0.99) * len(used):
                break
    members, poses, T_earth_map = best
    # Where no two agree, there are too few to say which is wrong.
    counts = [len(used) == 1 or index in members for index in range(len(used))]
    return poses, _told(frames[0], T_earth_map, used, poses, counts)


@dataclass(frozen=True, slots=True)
class _Start:
    """A first guess, and the one or two fixes that say it."""

    T_earth_map: SE2
    members: tuple[int, ...]


def _points(fixes: Sequence[Fix], poses: Component) -> FloatArray:
    """(N, 3): where the graph has the fixes' points, and the yaw of their submaps."""
    return np.array([(poses[f.submap_id] @ SE2(*f.point)).as_array() for f in fixes])


def _starts(fixes: Sequence[Fix], poses: Component) -> list[_Start]:
    """What each two fixes, and each with a heading, say, the best first.

    That has the least median of distances (Rousseeuw 1984): fewer than half may be wrong. None
    where nothing says how the map is turned.
    """
    points = _points(fixes, poses)
    places = np.array([fix.place.as_array() for fix in fixes])
    chosen = np.unique(np.linspace(0, len(fixes) - 1, _MAX_STARTS).astype(int)).tolist()
    turns: list[tuple[float, tuple[int, ...]]] = [
        (float(places[i, 2] - points[i, 2]), (i,))
        for i in chosen
        if math.isfinite(fixes[i].sigma_rad)
    ]
    for i, j in itertools.combinations(chosen, 2):
        here, there = points[j, :2] - points[i, :2], places[j, :2] - places[i, :2]
        if math.hypot(*here) >= _MIN_APART_M:
            turns.append((math.atan2(*there[::-1]) - math.atan2(*here[::-1]), (i, j)))
    sigmas = np.array([fix.sigma_m for fix in fixes])
    rank = min(len(fixes), (len(fixes) + 3) // 2) - 1
    ranked: list[tuple[float, int, _Start]] = []
    for number, (turn, members) in enumerate(turns):
        moved = SE2(0.0, 0.0, turn).apply(points[:, :2])
        shift = (places[members, :2] - moved[members, :]).mean(axis=0)
        off = np.hypot(*(moved + shift - places[:, :2]).T) / sigmas
        worth = float(np.partition(off, rank)[rank])
        T_earth_map = SE2(float(shift[0]), float(shift[1]), turn)
        ranked.append((worth, number, _Start(T_earth_map, members)))
    return [start for *_, start in sorted(ranked, key=lambda entry: entry[:2])]


class _Pull:
    """A graph with the earth in it, and its fixes."""

    def __init__(self, component: Component, edges: Sequence[Edge], fixes: Sequence[Fix]) -> None:
        self._component, self._fixes, self._is_rigid = component, fixes, not edges
        self._root = next(i for i, pose in component.items() if pose == SE2())
        # Coordinates on earth are large: a turn about their origin would drown all else.
        x_m, y_m = np.mean([[fix.place.x, fix.place.y] for fix in fixes], axis=0).tolist()
        self._T_earth_near = SE2(x_m, y_m)
        self._firm: list[AnyEdge[Any]] = list(edges)
        self._edges: list[AnyEdge[Any]] = []
        self._limits: list[float] = []
        for index, fix in enumerate(fixes):
            motion = SE2(*fix.point)
            if self._is_rigid:
                motion = component[fix.submap_id] @ motion
            end = self._root if self._is_rigid else fix.submap_id
            self._firm.append(AnyEdge[_Node](index, end, motion, np.zeros((3, 3))))
            sigmas = np.array([fix.sigma_m, fix.sigma_m, min(fix.sigma_rad, _NO_IDEA_RAD)])
            near = self._T_earth_near.inverse() @ fix.place
            self._edges.append(AnyEdge[_Node](index, _EARTH, near, np.diag(sigmas**2)))
            num_known = 3 if math.isfinite(fix.sigma_rad) else 2
            self._limits.append(float(scipy.special.chdtri(num_known, 1.0 - _PROBABILITY)))

    def gathered(self, start: _Start) -> tuple[list[int], Component, SE2]:
        """Indices of the fixes that agree, the poses with them, and ``T_earth_map``."""
        members = list(start.members)
        poses = self._initial(start.T_earth_map)
        chances = [2] * len(self._fixes)  # to come in again after it was put out
        while True:
            poses = self._solved(members, poses)
            distances = self._distances(members, poses)
            worst = max(members, key=lambda i: distances[i] / self._limits[i])
            if distances[worst] > self._limits[worst]:
                members.remove(worst)
                chances[worst] -= 1
                if not members:
                    break
                continue
            passing = [
                i
                for i in range(len(self._fixes))
                if i not in members and chances[i] and distances[i] <= self._limits[i]
            ]
            if not passing:
                break
            # No more at a time than are in: few of them do not say much of the others.
            passing.sort(key=lambda i: (distances[i] / self._limits[i], i))
            members += passing[: len(members)]
        T_earth_map = self._T_earth_near @ poses[_EARTH].inverse()
        bent = self._component if self._is_rigid else {i: poses[i] for i in self._component}
        return members, bent, T_earth_map

    def _initial(self, T_earth_map: SE2) -> dict[_Node, SE2]:
        initial: dict[_Node, SE2] = {self._root: SE2()}
        if not self._is_rigid:
            initial = dict(self._component.items())
        initial[_EARTH] = T_earth_map.inverse() @ self._T_earth_near
        for index, fix in enumerate(self._fixes):
            initial[index] = self._component[fix.submap_id] @ SE2(*fix.point)
        return initial

    def _solved(self, members: Sequence[int], initial: dict[_Node, SE2]) -> dict[_Node, SE2]:
        firm = [*self._firm, *(self._edges[i] for i in members)]
        return solve_graph(self._root, firm, [], initial, _PROBABILITY).T_anchor_pose

    def _distances(self, members: Sequence[int], poses: dict[_Node, SE2]) -> list[float]:
        """Squared Mahalanobis distance of each fix from what the members but itself say."""
        edges = [*self._firm, *(self._edges[i] for i in members)]
        marginals = Marginals(self._root, edges, poses)
        T_earth_root = poses[_EARTH].inverse()
        found = []
        for index, edge in enumerate(self._edges):
            size = 3 if math.isfinite(self._fixes[index].sigma_rad) else 2
            at = T_earth_root @ poses[index]
            off = at.as_array() - edge.T_target_source.as_array()
            off[2] = wrap_angle(off[2])
            graph = marginals.covariance(_EARTH, index)
            covariance = edge.covariance + (-graph if index in members else graph)
            values, axes = np.linalg.eigh(covariance[:size, :size])
            is_known = values > _LEAST_SHARE * self._fixes[index].sigma_m ** 2
            along = (axes.T @ off[:size])[is_known]
            found.append(float(np.sum(along**2 / values[is_known])))
        return found


def _told(
    frame: str, T_earth_map: SE2, fixes: Sequence[Fix], poses: Component, counts: Sequence[bool]
) -> Georeference:
    fits = []
    for fix, point, is_used in zip(fixes, _points(fixes, poses), counts, strict=True):
        x_m, y_m = T_earth_map.apply(point[:2]) - (fix.place.x, fix.place.y)
        turn = wrap_angle(point[2] + T_earth_map.yaw - fix.place.yaw)
        metres = math.hypot(x_m, y_m)
        sigmas = math.hypot(metres / fix.sigma_m, float(turn) / fix.sigma_rad)
        fits.append(FixFit(fix, metres, sigmas, is_used))
    return Georeference(frame, T_earth_map, tuple(fits))
