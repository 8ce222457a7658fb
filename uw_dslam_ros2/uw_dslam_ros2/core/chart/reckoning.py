"""What dead reckoning alone says of a path, where that is good enough to be held on to.

Matching pings moves a path by centimetres from one ping to the next, and closing loops moves
whole submaps; what instruments say of the way between two pings is often better than that, but for
what they do wrong all the time: a log's scale, and a gyro's drift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import wrap_angle

__all__ = ["follows", "steps_beside"]

FloatArray = NDArray[np.float64]


def follows(dead: FloatArray, times_s: FloatArray, poses: FloatArray) -> tuple[float, float]:
    """How far [m] dead reckoning stays from a path that it is laid on, and how it is stretched.

    Parameters
    ----------
    dead
        Poses (K, 3) by navigation alone, in any frame.
    times_s
        Time (K,) of each.
    poses
        The path (K, 3). Dead reckoning is turned, stretched and bent evenly in time until it lies
        nearest to that.

    Returns
    -------
    Root mean square of the distances, and the factor on dead reckoning's way, both 0 or more.
    """
    steps = np.diff(dead[:, 0] + 1j * dead[:, 1])
    middle_s = 0.5 * (times_s[1:] + times_s[:-1]) - times_s[0]
    # A drift of the heading turns each step by a little more than the one before.
    way = np.concatenate([[0.0], np.cumsum(steps)])
    bent = np.concatenate([[0.0], np.cumsum(1j * middle_s * steps)])
    design = np.column_stack([way, bent, np.ones(len(dead))])
    target = poses[:, 0] + 1j * poses[:, 1]
    found = np.linalg.lstsq(design, target, rcond=None)[0]
    away_m = np.sqrt((np.abs(design @ found - target) ** 2).mean())
    return float(away_m), float(abs(found[0]))


def steps_beside(dead: FloatArray, poses: FloatArray) -> FloatArray:
    """What dead reckoning (M, 3) says of each step that a path (M, 3) does not, (M - 1, 3).

    In the path's frame [m], [rad]. A turn within a step swings its second half round.
    """
    heading = poses[:-1, 2] - dead[:-1, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    dx, dy = np.diff(dead[:, :2], axis=0).T
    said = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy])
    own = np.diff(poses[:, :2], axis=0)
    turn = wrap_angle(np.diff(dead[:, 2]) - np.diff(poses[:, 2]))
    swing = 0.5 * turn[:, None] * np.column_stack([-own[:, 1], own[:, 0]])
    return np.column_stack([said - own - swing, turn])
