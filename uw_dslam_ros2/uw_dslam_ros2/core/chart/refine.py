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

from uw_dslam_ros2.core.chart.bending import (
    NOTHING,
    WAY_SIGMA,
    Problem,
    Track,
    arranged,
    bends,
    prior,
)

__all__ = ["Refined", "range_scales", "refine_tracks"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STRETCH_SIGMA = 0.02
"""Of ranges, by a speed of sound that nobody set."""
_SIGMAS = 2.0
"""Ranges are too long where it takes a path that is this much worse to explain it otherwise."""
_RANGE_SIGMA = 0.004
"""Of ranges, by a speed of sound that somebody set."""
_NEAR_BLOCKS = 0.25
"""Dead reckoning that stays so near to the path is better than that, if its log is exact."""
_INFORMATION_SHARE = 0.1
"""Neighbouring echoes err together."""
_ITERATIONS = 10
_MAX_ECHOES, _FEW_ECHOES = 60, 20
"""Of one ping; more of the same walls add time, not accuracy."""
_LEAST_ECHOES = 12
_MAX_FLATNESS = 0.15
"""A block is a wall where its echoes spread this much less across than along (variances)."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """``T_map_sonar`` (K, 3) of one track's pings, and the turn of its sonar that is in it.

    They agree where ranges count times ``range_scale`` beside the track's own.
    """

    poses: FloatArray
    mounting_rad: float
    range_scale: float = 1.0


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
    problem = arranged(tracks, _MAX_ECHOES, _NEAR_BLOCKS * block_m)
    if len(problem.echo) == 0:
        return [Refined(track.poses, 0.0) for track in tracks]
    found = _solved(problem, *prior(problem, stretch_sigma=_RANGE_SIGMA), noise_m, block_m)
    size = _size(problem, found)
    poses, turns = problem.poses + bends(problem, found), problem.turns(found)
    middle = poses[:, :2].mean(axis=0)
    poses[:, :2] = middle + size * (poses[:, :2] - middle)
    scales = size * (1.0 + problem.stretches(found))
    return [
        Refined(poses[problem.track == t], float(turns[t]), float(scales[t]))
        for t in range(len(tracks))
    ]


def _size(problem: Problem, found: FloatArray) -> float:
    """Factor on poses and ranges: echoes lie the nearer to their walls, the smaller all is drawn.

    So they say nothing of it; how well logs and speeds of sound are known does.
    """
    if not problem.is_steady.any():
        return 1.0
    of_range, of_way = 1.0 / _RANGE_SIGMA**2, 1.0 / WAY_SIGMA**2
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
    problem = arranged(alone, _FEW_ECHOES, 0.0)
    if len(problem.echo) == 0:
        return [1.0] * len(tracks)
    known = prior(problem, stretch_sigma=_STRETCH_SIGMA, way_sigma=NOTHING, only_steady=False)
    stretches = problem.stretches(_solved(problem, *known, noise_m, block_m))
    is_long = stretches < -WAY_SIGMA
    num_long = max(1, int(is_long.sum()))
    if stretches[is_long].sum() / num_long > -_SIGMAS * WAY_SIGMA / math.sqrt(num_long):
        return [1.0] * len(tracks)
    return [1.0 + float(s) if s < -WAY_SIGMA else 1.0 for s in stretches]


def _solved(
    problem: Problem, known: sp.csr_matrix, said: FloatArray, noise_m: float, block_m: float
) -> FloatArray:
    """All unknowns; see `Problem`."""
    found = np.zeros(known.shape[1])
    for iteration in range(_ITERATIONS):
        shift = 0.5 * block_m * (iteration % 2)
        width = max(noise_m, 0.25 * block_m * 0.6**iteration)
        found += _step(problem, found, known, said, block_m, shift, noise_m, width)
    return found


def _step(
    problem: Problem,
    found: FloatArray,
    known: sp.csr_matrix,
    said: FloatArray,
    block_m: float,
    shift_m: float,
    noise_m: float,
    width_m: float,
) -> FloatArray:
    """One Gauss-Newton step of all unknowns."""
    poses = problem.poses + bends(problem, found)
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
    information = jacobian.T @ weighted - sums.T @ inverse @ sums + known.T @ known
    gradient = weighted.T @ away + known.T @ (known @ found - said)
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
