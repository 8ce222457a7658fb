"""Poses of pings bent until all pings see the same walls.

Echoes of one small block of the plane that lie along a line are one wall, whoever heard them. How
far each lies from that wall is made small over all poses at once; the walls' places are eliminated
and need not be known (bundle adjustment on eigenvalues: Liu and Zhang 2021, IEEE RA-L 6(2); poses
and map together: Wang et al. 2022, Occupancy-SLAM). What navigation says of the way from ping to
ping keeps the path stiff.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

__all__ = ["Track", "range_scales", "refine_tracks"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NODE_M = 2.0
"""A path bends at nodes this far apart."""
_BEND_SIGMA_M, _BEND_SIGMA_RAD = 0.04, 0.004
"""How much one node's correction differs from the next one's."""
_ANCHOR_SIGMA_M, _ANCHOR_SIGMA_RAD = 0.5, 0.02
_STRETCH_SIGMA, _MIN_STRETCH = 0.02, 0.01
"""Of ranges, by a speed of sound that nobody set; what is less may come of thick echoes."""
_NO_STRETCH = 1e-6
_INFORMATION_SHARE = 0.1
"""Neighbouring echoes err together."""
_ITERATIONS = 10
_MAX_ECHOES, _FEW_ECHOES = 60, 20
"""Of one ping; more of the same walls add time, not accuracy."""
_LEAST_ECHOES = 12
_MAX_FLATNESS = 0.15
"""A block is a wall where its echoes spread this much less across than along (variances)."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Pings of one vehicle in order: ``T_map_sonar`` (K, 3), and each one's echoes (N, 2) [m].

    Ranges count times ``range_scale``.
    """

    poses: FloatArray
    echoes: Sequence[NDArray[np.floating]]
    range_scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """All echoes in arrays; ``node`` (K,) and ``share`` (K,) place pings between nodes."""

    poses: FloatArray
    track: IntArray
    node: IntArray
    share: FloatArray
    node_centers: FloatArray
    node_track: IntArray
    ping: IntArray
    echo: FloatArray

    @property
    def num_nodes(self) -> int:
        return len(self.node_track)


def refine_tracks(tracks: Sequence[Track], noise_m: float, block_m: float) -> list[FloatArray]:
    """Bend several vehicles' paths in one frame until their echoes meet on common walls.

    Returns ``T_map_sonar`` (K, 3) of each track.

    Parameters
    ----------
    tracks
        Of all vehicles that share the frame.
    noise_m
        Standard deviation of an echo across a wall.
    block_m
        Side of the squares in which a wall is straight; poses that are farther off are not found.
    """
    problem = _arranged(tracks, _MAX_ECHOES)
    if len(problem.echo) == 0:
        return [track.poses for track in tracks]
    found = _solved(problem, noise_m, block_m, stretch_sigma=0.0)
    poses = problem.poses + _bends(problem, found)
    return [poses[problem.track == t] for t in range(len(tracks))]


def range_scales(tracks: Sequence[Track], noise_m: float, block_m: float) -> list[float]:
    """Factor on each track's ranges without which its pings do not agree; mostly 1.

    Ranges that are too long draw a map that is too large, and poses would follow it. A path and
    ranges that are both too long agree, so that only the path's own measure tells: ranges that
    are said to be too *short* are left alone, for it is rather that measure which is too long (see
    `core.doctor`). Parameters as in `refine_tracks`.
    """
    problem = _arranged(tracks, _FEW_ECHOES)
    if len(problem.echo) == 0:
        return [1.0] * len(tracks)
    found = _solved(problem, noise_m, block_m, _STRETCH_SIGMA)
    stretches = found[3 * problem.num_nodes :]
    return [1.0 + float(s) if s < -_MIN_STRETCH else 1.0 for s in stretches]


def _solved(problem: _Problem, noise_m: float, block_m: float, stretch_sigma: float) -> FloatArray:
    """Bends of all nodes (3 M,), then stretches of all tracks (T,)."""
    num_tracks = int(problem.node_track.max()) + 1
    found = np.zeros(3 * problem.num_nodes + num_tracks)
    prior = _prior(problem, num_tracks, max(stretch_sigma, _NO_STRETCH))
    for iteration in range(_ITERATIONS):
        shift = 0.5 * block_m * (iteration % 2)
        width = max(noise_m, 0.25 * block_m * 0.6**iteration)
        found += _step(problem, found, prior, block_m, shift, noise_m, width)
    return found


def _arranged(tracks: Sequence[Track], max_echoes: int) -> _Problem:
    nodes, shares, centers, owners, pings, echoes, first = [], [], [], [], [], [], 0
    num_pings = 0
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
        first += count
        for points in track.echoes:
            kept = points[:: max(1, -(-len(points) // max_echoes))].astype(np.float64)
            kept *= track.range_scale
            pings.append(np.full(len(kept), num_pings))
            echoes.append(kept)
            num_pings += 1
    return _Problem(
        np.vstack([track.poses for track in tracks]),
        np.repeat(np.arange(len(tracks)), [len(track.poses) for track in tracks]),
        np.concatenate(nodes),
        np.concatenate(shares),
        np.vstack(centers),
        np.concatenate(owners),
        np.concatenate(pings),
        np.vstack(echoes),
    )


def _bends(problem: _Problem, found: FloatArray) -> FloatArray:
    """Correction (K, 3) of each ping: a shift of its place, and a turn about it."""
    bend = found[: 3 * problem.num_nodes].reshape(-1, 3)
    share = problem.share[:, None]
    return (1.0 - share) * bend[problem.node] + share * bend[problem.node + 1]


def _prior(problem: _Problem, num_tracks: int, stretch_sigma: float) -> sp.csr_matrix:
    """Square root of the information on the nodes, x, y, yaw of each, and on the stretches."""
    same = np.flatnonzero(problem.node_track[1:] == problem.node_track[:-1])
    ones = np.ones(len(same))
    places = (np.tile(np.arange(len(same)), 2), np.concatenate([same, same + 1]))
    differences = sp.csr_matrix(
        (np.concatenate([-ones, ones]), places), (len(same), problem.num_nodes)
    )
    bends = sp.kron(differences, np.diag([1 / _BEND_SIGMA_M] * 2 + [1 / _BEND_SIGMA_RAD]))
    anchor = np.tile([1 / _ANCHOR_SIGMA_M] * 2 + [1 / _ANCHOR_SIGMA_RAD], problem.num_nodes)
    nodes = sp.vstack([bends, sp.diags(anchor / math.sqrt(problem.num_nodes))])
    stretches = sp.identity(num_tracks) / stretch_sigma
    return sp.block_diag([nodes, stretches]).tocsr()


def _step(
    problem: _Problem,
    found: FloatArray,
    prior: sp.csr_matrix,
    block_m: float,
    shift_m: float,
    noise_m: float,
    width_m: float,
) -> FloatArray:
    """One Gauss-Newton step (3 M + T,): of all nodes, then of all tracks' stretches."""
    poses = problem.poses + _bends(problem, found)
    stretch = found[3 * problem.num_nodes :]
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
    columns = np.column_stack([3 * node[:, None] + np.arange(6), 3 * problem.num_nodes + track])
    outward = (n * arm).sum(axis=1) / (1.0 + stretch[track])
    values = np.column_stack([(1.0 - share)[:, None] * by_node, share[:, None] * by_node, outward])
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
    gradient = weighted.T @ away + prior.T @ (prior @ found)
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
