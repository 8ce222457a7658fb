"""Paths that may bend: what is unknown of them, and what is known of that without any echo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.reckoning import follows, steps_beside

__all__ = [
    "DRIFT_M",
    "DRIFT_RAD",
    "NOTHING",
    "WAY_SIGMA",
    "Problem",
    "Track",
    "arranged",
    "bends",
    "prior",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NODE_M = 2.0
"""A path bends at nodes this far apart."""
DRIFT_M, DRIFT_RAD = 0.03, 0.003
"""How far a path and its heading drift on one metre, where nobody says; with the way's root."""
WAY_SIGMA, _MOUNTING_SIGMA_RAD = 0.01, 0.01
"""Of the way, by a velocity log's scale; of the sonar's yaw on the vehicle."""
_ANCHOR_SIGMA_M, _ANCHOR_SIGMA_RAD = 0.5, 0.02
_SIGMAS = 2.0
"""A log is worse than logs are where its scale is so far off."""
_HEADING_DRIFT_SIGMA = 3e-4
"""Of a heading, all the time the same [rad/s]: one degree a minute."""
_STEADY_SHARE = 0.2
"""Of the drift that navigation admits, what is not the same all the time."""
_NUM_CONSTANTS = 4
NOTHING = 1e-6
"""Standard deviation of what is not asked."""
_MAX_ECHOES_IN_ALL = 600_000
"""Of a mission of many hours."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Pings of one vehicle in order: ``T_map_sonar`` (K, 3), and each one's echoes (N, 2) [m].

    Ranges count times ``range_scale``. ``drift`` (K, 2) are standard deviations of what the path
    [m] and its heading [rad] gain on one metre there; `DRIFT_M` and `DRIFT_RAD` where nobody says.
    ``dead`` (K, 3) are poses of the sonar by dead reckoning alone, in any frame, at ``times_s``
    (K,).
    """

    poses: FloatArray
    echoes: Sequence[NDArray[np.floating]]
    range_scale: float = 1.0
    drift: FloatArray | None = None
    times_s: FloatArray | None = None
    dead: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All echoes in arrays; ``node`` (K,) and ``share`` (K,) place pings between nodes.

    ``node_drift`` (M, 2) is that of the way to the next node, ``node_said`` (M, 3) what dead
    reckoning says of it that the path does not, ``node_s`` (M,) how long it takes.
    ``is_steady`` (T,): of which tracks there is dead reckoning to hold on to.

    Unknowns are the bends of all nodes (3 M,), then of all tracks (T,) the stretch of ranges, the
    stretch of the way, the drift of the heading, and the sonar's turn.
    """

    tracks: Sequence[Track]
    poses: FloatArray
    track: IntArray
    node: IntArray
    share: FloatArray
    node_centers: FloatArray
    node_track: IntArray
    node_drift: FloatArray
    node_said: FloatArray
    node_s: FloatArray
    is_steady: NDArray[np.bool_]
    ping: IntArray
    echo: FloatArray

    @property
    def num_nodes(self) -> int:
        """Of all tracks."""
        return len(self.node_track)

    def stretches(self, found: FloatArray) -> FloatArray:
        """Of ranges (T,)."""
        return found[3 * self.num_nodes :][: len(self.tracks)]

    def ways(self, found: FloatArray) -> FloatArray:
        """Stretches of the way (T,)."""
        return found[3 * self.num_nodes + len(self.tracks) :][: len(self.tracks)]

    def turns(self, found: FloatArray) -> FloatArray:
        """Of the sonars (T,)."""
        return found[-len(self.tracks) :]


def arranged(tracks: Sequence[Track], max_echoes: int, near_m: float) -> Problem:
    """Put tracks into arrays: at most so many echoes of each ping.

    Dead reckoning is held on to where it stays within `near_m` of the path.
    """
    nodes, shares, centers, owners, drifts, first = [], [], [], [], [], 0
    says, lasts, is_steady = [], [], np.zeros(len(tracks), np.bool_)
    pings, echoes = [], []
    num_pings = 0
    in_all = sum(len(track.poses) for track in tracks)
    max_echoes = max(1, min(max_echoes, _MAX_ECHOES_IN_ALL // max(in_all, 1)))
    for t, track in enumerate(tracks):
        xy = track.poses[:, :2]
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        count = max(2, math.ceil(way[-1] / _NODE_M) + 1)
        at = way / max(way[-1], 1e-9) * (count - 1)
        node = np.minimum(at.astype(np.int64), count - 2)
        nodes.append(first + node)
        shares.append(at - node)
        knots = np.arange(count) * way[-1] / (count - 1)
        centers.append(np.column_stack([np.interp(knots, way, column) for column in xy.T]))
        owners.append(np.full(count, t))
        middles = knots + 0.5 * knots[1]
        drift = track.drift
        if drift is None:
            drift = np.full((len(way), 2), (DRIFT_M, DRIFT_RAD))
        said, last_s = np.zeros((count, 3)), np.zeros(count)
        dead, times_s = track.dead, track.times_s
        if dead is not None and times_s is not None:
            away_m, factor = follows(dead, times_s, track.poses)
            is_steady[t] = away_m < near_m and abs(factor - 1.0) < _SIGMAS * WAY_SIGMA
        if is_steady[t] and dead is not None and times_s is not None:
            drift = _STEADY_SHARE * drift
            said[:-1] = steps_beside(_at(knots, way, dead), _at(knots, way, track.poses))
            last_s[:-1] = np.diff(np.interp(knots, way, times_s))
        says.append(said)
        lasts.append(last_s)
        drifts.append(np.column_stack([np.interp(middles, way, d) for d in drift.T]))
        first += count
        for points in track.echoes:
            kept = points[:: max(1, -(-len(points) // max_echoes))].astype(np.float64)
            kept *= track.range_scale
            pings.append(np.full(len(kept), num_pings))
            echoes.append(kept)
            num_pings += 1
    return Problem(
        tracks,
        np.vstack([track.poses for track in tracks]),
        np.repeat(np.arange(len(tracks)), [len(track.poses) for track in tracks]),
        np.concatenate(nodes),
        np.concatenate(shares),
        np.vstack(centers),
        np.concatenate(owners),
        np.vstack(drifts),
        np.vstack(says),
        np.concatenate(lasts),
        is_steady,
        np.concatenate(pings),
        np.vstack(echoes),
    )


def _at(knots: FloatArray, way: FloatArray, poses: FloatArray) -> FloatArray:
    """Poses (M, 3) at places (M,) along a path of poses (K, 3)."""
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    return np.column_stack([np.interp(knots, way, column) for column in columns])


def bends(problem: Problem, found: FloatArray) -> FloatArray:
    """Correction (K, 3) of each ping: a shift of its place, and a turn about it."""
    bend = found[: 3 * problem.num_nodes].reshape(-1, 3)
    share = problem.share[:, None]
    correction = (1.0 - share) * bend[problem.node] + share * bend[problem.node + 1]
    correction[:, 2] += problem.turns(found)[problem.track]
    return correction


def prior(
    problem: Problem,
    *,
    stretch_sigma: float,
    way_sigma: float = WAY_SIGMA,
    only_steady: bool = True,
) -> tuple[sp.csr_matrix, FloatArray]:
    """Square root (rows, unknowns) of the information without any echo, and what it says (rows,).

    Ranges are stretched of all tracks, or only of those that hold on to dead reckoning.
    """
    num_tracks, num_nodes = len(problem.tracks), problem.num_nodes
    first = np.flatnonzero(problem.node_track[1:] == problem.node_track[:-1])
    track = problem.node_track[first]
    step = problem.node_centers[first + 1] - problem.node_centers[first]
    nothing = np.zeros(len(first))
    ones = np.ones(len(first))
    rows = []
    # A node is moved as the one before it, and as the way between them turns and stretches.
    for axis, swing in ((0, -step[:, 1]), (1, step[:, 0]), (2, nothing)):
        along = step[:, axis] if axis < 2 else nothing
        columns = (3 * first + axis, 3 * first + 3 + axis, 3 * first + 2, 3 * first + 5)
        values = (-ones, ones, -0.5 * swing, -0.5 * swing)
        of_way = 3 * num_nodes + num_tracks + track
        lasts = problem.node_s[first] if axis == 2 else nothing
        rows.append(
            sp.csr_matrix(
                (
                    np.concatenate([*values, -along, -lasts]),
                    (
                        np.tile(np.arange(len(first)), 6),
                        np.concatenate([*columns, of_way, of_way + num_tracks]),
                    ),
                ),
                (len(first), 3 * num_nodes + _NUM_CONSTANTS * num_tracks),
            )
        )
    drift = problem.node_drift[first][:, [0, 0, 1]]
    weight = 1.0 / (math.sqrt(_NODE_M) * np.maximum(drift, NOTHING))
    steps = [sp.diags(weight[:, axis]) @ rows[axis] for axis in range(3)]
    anchor = np.tile([1 / _ANCHOR_SIGMA_M] * 2 + [1 / _ANCHOR_SIGMA_RAD], num_nodes)
    is_steady = problem.is_steady
    sigmas = [
        np.where(is_steady | (not only_steady), stretch_sigma, NOTHING),
        np.full(num_tracks, way_sigma),
        np.where(is_steady, _HEADING_DRIFT_SIGMA, NOTHING),
        np.full(num_tracks, _MOUNTING_SIGMA_RAD),
    ]
    own = np.concatenate([anchor / math.sqrt(num_nodes), 1.0 / np.concatenate(sigmas)])
    said = (weight * problem.node_said[first]).T.ravel()
    return sp.vstack([*steps, sp.diags(own)]).tocsr(), np.append(said, np.zeros(len(own)))
