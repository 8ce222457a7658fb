"""Poses of pings bent until all pings see the same walls.

Echoes of one small block of the plane that lie along a line are one wall, whoever heard them. How
far each lies from that wall is made small over all poses at once; the walls' places are eliminated
and need not be known (bundle adjustment on eigenvalues: Liu and Zhang 2021, IEEE RA-L 6(2); poses
and map together: Wang et al. 2022, Occupancy-SLAM). What navigation says of the way from ping to
ping keeps the path stiff: where it turns, all that follows swings round. What is wrong with an
instrument all the time has unknowns of its own: how the sonar is turned on the vehicle, a factor
on the way and, where dead reckoning is at hand, a drift of the heading and a factor on ranges.
Echoes then tell all but how large the map is, which is taken from how well instruments are known.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from uw_dslam_ros2.core.chart.reckoning import follows, steps_beside

__all__ = ["DRIFT_M", "DRIFT_RAD", "Refined", "Track", "range_scales", "refine_tracks"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NODE_M = 2.0
"""A path bends at nodes this far apart."""
DRIFT_M, DRIFT_RAD = 0.03, 0.003
"""How far a path and its heading drift on one metre, where nobody says; with the way's root."""
_WAY_SIGMA, _MOUNTING_SIGMA_RAD = 0.01, 0.01
"""Of the way, by a velocity log's scale; of the sonar's yaw on the vehicle."""
_ANCHOR_SIGMA_M, _ANCHOR_SIGMA_RAD = 0.5, 0.02
_STRETCH_SIGMA = 0.02
"""Of ranges, by a speed of sound that nobody set."""
_SIGMAS = 2.0
"""Ranges are too long where it takes a path that is this much worse to explain it otherwise."""
_RANGE_SIGMA = 0.004
"""Of ranges, by a speed of sound that somebody set."""
_HEADING_DRIFT_SIGMA = 3e-4
"""Of a heading, all the time the same [rad/s]: one degree a minute."""
_STEADY_SHARE = 0.2
"""Of the drift that navigation admits, what is not the same all the time."""
_NEAR_BLOCKS = 0.25
"""Dead reckoning that stays so near to the path is better than that, if its log is exact."""
_NUM_CONSTANTS = 4
_NOTHING = 1e-6
"""Standard deviation of what is not asked."""
_INFORMATION_SHARE = 0.1
"""Neighbouring echoes err together."""
_ITERATIONS = 10
_MAX_ECHOES, _FEW_ECHOES, _MAX_ECHOES_IN_ALL = 60, 20, 600_000
"""Of one ping, and of a mission of many hours; more of the same walls add time, not accuracy."""
_LEAST_ECHOES = 12
_MAX_FLATNESS = 0.15
"""A block is a wall where its echoes spread this much less across than along (variances)."""


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
class Refined:
    """``T_map_sonar`` (K, 3) of one track's pings, and the turn of its sonar that is in it.

    They agree where ranges count times ``range_scale`` beside the track's own.
    """

    poses: FloatArray
    mounting_rad: float
    range_scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
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


def refine_tracks(tracks: Sequence[Track], noise_m: float, block_m: float) -> list[Refined]:
    """Bend several vehicles' paths in one frame until their echoes meet on common walls.

    Parameters
    ----------
    tracks
        Of all vehicles that share the frame.
    noise_m
        Standard deviation of an echo across a wall.
    block_m
        Side of the squares in which a wall is straight; poses that are farther off are not found.
    """
    problem = _arranged(tracks, _MAX_ECHOES, _NEAR_BLOCKS * block_m)
    if len(problem.echo) == 0:
        return [Refined(track.poses, 0.0) for track in tracks]
    found = _solved(problem, *_prior(problem, stretch_sigma=_RANGE_SIGMA), noise_m, block_m)
    size = _size(problem, found)
    poses, turns = problem.poses + _bends(problem, found), problem.turns(found)
    middle = poses[:, :2].mean(axis=0)
    poses[:, :2] = middle + size * (poses[:, :2] - middle)
    scales = size * (1.0 + problem.stretches(found))
    return [
        Refined(poses[problem.track == t], float(turns[t]), float(scales[t]))
        for t in range(len(tracks))
    ]


def _size(problem: _Problem, found: FloatArray) -> float:
    """Factor on poses and ranges: echoes lie the nearer to their walls, the smaller all is drawn.

    So they say nothing of it; how well logs and speeds of sound are known does.
    """
    if not problem.is_steady.any():
        return 1.0
    of_range, of_way = 1.0 / _RANGE_SIGMA**2, 1.0 / _WAY_SIGMA**2
    said = of_range * problem.stretches(found).mean() + of_way * problem.ways(found).mean()
    return 1.0 - float(said) / (of_range + of_way)


def range_scales(tracks: Sequence[Track], noise_m: float, block_m: float) -> list[float]:
    """Factor on each track's ranges without which its pings do not agree; mostly 1.

    Ranges that are too long draw a map that is too large, and poses would follow it. But a path
    that is too short looks the same, so ranges are shortened only by more than what a velocity
    log gets wrong; of several tracks in one water that all say so, it takes less. Ranges that
    are said to be too *short* are left alone, for it is rather the path that is too long (see
    `core.doctor`). Parameters as in `refine_tracks`.
    """
    alone = [dataclasses.replace(track, dead=None) for track in tracks]
    problem = _arranged(alone, _FEW_ECHOES, 0.0)
    if len(problem.echo) == 0:
        return [1.0] * len(tracks)
    prior = _prior(problem, stretch_sigma=_STRETCH_SIGMA, way_sigma=_NOTHING, only_steady=False)
    stretches = problem.stretches(_solved(problem, *prior, noise_m, block_m))
    is_long = stretches < -_WAY_SIGMA
    num_long = max(1, int(is_long.sum()))
    if stretches[is_long].sum() / num_long > -_SIGMAS * _WAY_SIGMA / math.sqrt(num_long):
        return [1.0] * len(tracks)
    return [1.0 + float(s) if s < -_WAY_SIGMA else 1.0 for s in stretches]


def _solved(
    problem: _Problem, prior: sp.csr_matrix, said: FloatArray, noise_m: float, block_m: float
) -> FloatArray:
    """All unknowns; see `_Problem`."""
    found = np.zeros(prior.shape[1])
    for iteration in range(_ITERATIONS):
        shift = 0.5 * block_m * (iteration % 2)
        width = max(noise_m, 0.25 * block_m * 0.6**iteration)
        found += _step(problem, found, prior, said, block_m, shift, noise_m, width)
    return found


def _arranged(tracks: Sequence[Track], max_echoes: int, near_m: float) -> _Problem:
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
            is_steady[t] = away_m < near_m and abs(factor - 1.0) < _SIGMAS * _WAY_SIGMA
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
    return _Problem(
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


def _bends(problem: _Problem, found: FloatArray) -> FloatArray:
    """Correction (K, 3) of each ping: a shift of its place, and a turn about it."""
    bend = found[: 3 * problem.num_nodes].reshape(-1, 3)
    share = problem.share[:, None]
    correction = (1.0 - share) * bend[problem.node] + share * bend[problem.node + 1]
    correction[:, 2] += problem.turns(found)[problem.track]
    return correction


def _prior(
    problem: _Problem,
    *,
    stretch_sigma: float,
    way_sigma: float = _WAY_SIGMA,
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
    weight = 1.0 / (math.sqrt(_NODE_M) * np.maximum(drift, _NOTHING))
    bends = [sp.diags(weight[:, axis]) @ rows[axis] for axis in range(3)]
    anchor = np.tile([1 / _ANCHOR_SIGMA_M] * 2 + [1 / _ANCHOR_SIGMA_RAD], num_nodes)
    is_steady = problem.is_steady
    sigmas = [
        np.where(is_steady | (not only_steady), stretch_sigma, _NOTHING),
        np.full(num_tracks, way_sigma),
        np.where(is_steady, _HEADING_DRIFT_SIGMA, _NOTHING),
        np.full(num_tracks, _MOUNTING_SIGMA_RAD),
    ]
    own = np.concatenate([anchor / math.sqrt(num_nodes), 1.0 / np.concatenate(sigmas)])
    said = (weight * problem.node_said[first]).T.ravel()
    return sp.vstack([*bends, sp.diags(own)]).tocsr(), np.append(said, np.zeros(len(own)))


def _step(
    problem: _Problem,
    found: FloatArray,
    prior: sp.csr_matrix,
    said: FloatArray,
    block_m: float,
    shift_m: float,
    noise_m: float,
    width_m: float,
) -> FloatArray:
    """One Gauss-Newton step of all unknowns."""
    poses = problem.poses + _bends(problem, found)
    stretch = problem.stretches(found)
    ping = problem.ping
    ex, ey = problem.echo.T * (1.0 + stretch[problem.track[ping]])
    cos, sin = np.cos(poses[ping, 2]), np.sin(poses[ping, 2])
    arm = np.column_stack([cos * ex - sin * ey, sin * ex + cos * ey])
    points = poses[ping, :2] + arm
    block, mean, normal, is_wall = _walls(points, block_m, shift_m)
    keep = np.flatnonzero(is_wall[block])
    block, point_ping, arm = block[keep], ping[keep], arm[keep]
    away = ((points[keep] - mean[block]) * normal[block]).sum(axis=1)
    # Far off lies something else: Cauchy's weight.
    weight = _INFORMATION_SHARE / (noise_m**2 * (1.0 + (away / width_m) ** 2))
    total = np.bincount(block, weight, minlength=len(mean))
    away -= (np.bincount(block, weight * away, minlength=len(mean)) / np.maximum(total, 1e-12))[
        block
    ]
    n = normal[block]
    turn = n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]
    node, share = problem.node[point_ping], problem.share[point_ping]
    by_node = np.column_stack([n, turn])
    track = problem.track[point_ping]
    of_range = 3 * problem.num_nodes + track
    of_turn = len(found) - len(problem.tracks) + track
    columns = np.column_stack([3 * node[:, None] + np.arange(6), of_range, of_turn])
    outward = (n * arm).sum(axis=1) / (1.0 + stretch[track])
    share = share[:, None]
    values = np.column_stack([(1.0 - share) * by_node, share * by_node, outward, turn])
    rows = np.repeat(np.arange(len(keep)), columns.shape[1])
    shape = (len(keep), len(found))
    jacobian = sp.csr_matrix((values.ravel(), (rows, columns.ravel())), shape)
    weighted = sp.diags(weight) @ jacobian
    members = sp.csr_matrix(
        (np.ones(len(keep)), (block, np.arange(len(keep)))), (len(mean), len(keep))
    )
    sums = members @ weighted
    inverse = sp.diags(1.0 / np.maximum(total, 1e-12))
    information = jacobian.T @ weighted - sums.T @ inverse @ sums + prior.T @ prior
    gradient = weighted.T @ away + prior.T @ (prior @ found - said)
    return -np.asarray(spsolve(information.tocsc(), gradient))


def _walls(
    points: FloatArray, block_m: float, shift_m: float
) -> tuple[IntArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Blocks of points (N, 2): number of each point's (N,), mean, normal (M, 2), and is a wall."""
    cells = np.floor((points + shift_m) / block_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, block = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    count = np.bincount(block).astype(np.float64)
    mean = np.column_stack([np.bincount(block, points[:, k]) / count for k in range(2)])
    local = points - mean[block]
    xx, yy, xy = (
        np.bincount(block, local[:, i] * local[:, j]) / count for i, j in ((0, 0), (1, 1), (0, 1))
    )
    half = np.hypot(0.5 * (xx - yy), xy)
    small, large = 0.5 * (xx + yy) - half, 0.5 * (xx + yy) + half
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)  # of the wall
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    is_wall = (count >= _LEAST_ECHOES) & (small < _MAX_FLATNESS * large)
    is_wall &= large > (0.2 * block_m) ** 2
    return block.astype(np.int64), mean, normal, is_wall
