"""Voting by pairs of equal distance: a pair of the source may be any such pair of the target."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.registration.baselines.icp import icp
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["pair_voting"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
VoteArray = NDArray[np.uint16]


@njit(cache=True, nogil=True)
def _vote(
    source_pairs: FloatArray,
    target_pairs: FloatArray,
    target_lengths: FloatArray,
    tolerance: float,
    votes: VoteArray,
    low: FloatArray,
    cell: float,
) -> int:
    """Add a vote for each pair of pairs: rows of x and y of the middle, direction, length.

    ``votes`` is (angles, rows, columns); `target_pairs` is sorted by length. Both directions of a
    target pair are voted for. Returns the number of votes.
    """
    num_angles, num_rows, num_cols = votes.shape
    count = 0
    for i in range(source_pairs.shape[0]):
        x, y, direction, length = source_pairs[i]
        first = np.searchsorted(target_lengths, length - tolerance)
        for j in range(first, target_pairs.shape[0]):
            if target_lengths[j] > length + tolerance:
                break
            for turn in range(2):
                yaw = (target_pairs[j, 2] - direction + turn * math.pi) % (2.0 * math.pi)
                cos, sin = math.cos(yaw), math.sin(yaw)
                t_x = target_pairs[j, 0] - cos * x + sin * y
                t_y = target_pairs[j, 1] - sin * x - cos * y
                angle = int(yaw / (2.0 * math.pi) * num_angles) % num_angles
                row = math.floor((t_y - low[1]) / cell)
                col = math.floor((t_x - low[0]) / cell)
                is_inside = 0 <= row < num_rows and 0 <= col < num_cols
                if is_inside and votes[angle, row, col] < 65535:
                    votes[angle, row, col] += 1
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _peaks(votes: VoteArray, num_peaks: int) -> IntArray:
    """Cells (K <= num_peaks, 3) of the fullest 3 x 3 x 3 neighbourhoods around local maxima."""
    num_angles, num_rows, num_cols = votes.shape
    least = max(2, int(votes.max()) // 2)
    best = np.zeros(num_peaks, np.int64)
    cells = np.zeros((num_peaks, 3), np.int64)
    found = 0
    for a in range(num_angles):
        for r in range(1, num_rows - 1):
            for c in range(1, num_cols - 1):
                value = votes[a, r, c]
                if value < least:
                    continue
                total, is_peak = np.int64(0), True
                for s in range(-1, 2):
                    near = votes[(a + s) % num_angles, r - 1 : r + 2, c - 1 : c + 2]
                    for u in range(3):
                        for v in range(3):
                            total += near[u, v]
                            is_peak = is_peak and near[u, v] <= value
                if not is_peak or total <= best[num_peaks - 1]:
                    continue
                place = num_peaks - 1
                while place > 0 and best[place - 1] < total:
                    best[place] = best[place - 1]
                    cells[place] = cells[place - 1]
                    place -= 1
                best[place] = total
                cells[place, 0], cells[place, 1], cells[place, 2] = a, r, c
                found = min(found + 1, num_peaks)
    return cells[:found]


def pair_voting(
    source: ArrayLike,
    target: ArrayLike,
    *,
    tolerance_m: float = 0.02,
    num_source_pairs: int = 1000,
    num_peaks: int = 10,
    polish_m: float = 0.05,
) -> BaselineResult:
    """Vote for the motions that bring pairs of equal length together; verify the fullest cells.

    Parameters
    ----------
    source, target : (m, 2) and (n, 2)
        Points [m]; two or more each, else the motion is None.
    tolerance_m : float
        Largest difference in length [m] of two pairs, and half the side of a cell of votes.
    num_source_pairs : int
        The longest pairs of the source are used, up to this many: they fix the heading best.
    num_peaks : int
        Cells that ICP polishes; the best truncated cost wins.
    """
    source, target = checked_points("source", source), checked_points("target", target)
    c_x, c_y = source.mean(axis=0), (target.min(axis=0) + target.max(axis=0)) / 2.0
    reach = float(np.linalg.norm(source - c_x, axis=1).max())
    if len(target) < 2 or reach <= 0.0:
        return BaselineResult(None, 0.0)
    source_pairs = _pairs(source - c_x)
    source_pairs = source_pairs[np.argsort(-source_pairs[:, 3], kind="stable")[:num_source_pairs]]
    target_pairs = _pairs(target - c_y)
    target_pairs = target_pairs[np.argsort(target_pairs[:, 3], kind="stable")]
    cell = 2.0 * tolerance_m
    half = float((target.max(axis=0) - target.min(axis=0)).max()) / 2.0 + reach
    size = math.ceil(2.0 * half / cell)
    num_angles = max(8, math.ceil(2.0 * math.pi * reach / cell))
    votes = np.zeros((num_angles, size, size), np.uint16)
    low = np.full(2, -half)
    lengths = np.ascontiguousarray(target_pairs[:, 3])
    num_votes = _vote(source_pairs, target_pairs, lengths, tolerance_m, votes, low, cell)
    best: BaselineResult | None = None
    for angle, row, col in _peaks(votes, num_peaks):
        yaw = 2.0 * math.pi * (angle + 0.5) / num_angles
        shift = low + cell * np.array([col + 0.5, row + 0.5])
        T_start = SE2(*(shift + c_y).tolist()) @ SE2(yaw=yaw) @ SE2(*(-c_x).tolist())
        found = icp(
            source,
            target,
            T_initial=T_start,
            first_cutoff_m=2.0 * polish_m,
            last_cutoff_m=polish_m,
            max_iterations=30,
        )
        if best is None or found.score > best.score:
            best = found
    if best is None:
        return BaselineResult(None, 0.0, {"num_votes": float(num_votes)})
    return BaselineResult(best.T_target_source, best.score, {"num_votes": float(num_votes)})


def _pairs(points: FloatArray) -> FloatArray:
    """Middle x, y, direction and length of all pairs, shape (N (N - 1) / 2, 4)."""
    i, j = np.triu_indices(len(points), k=1)
    middle, along = (points[i] + points[j]) / 2.0, points[j] - points[i]
    direction = np.arctan2(along[:, 1], along[:, 0])
    return np.column_stack([middle, direction, np.hypot(along[:, 0], along[:, 1])])
