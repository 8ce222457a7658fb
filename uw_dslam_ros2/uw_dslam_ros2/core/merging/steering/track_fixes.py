"""From positions at times to fixes of submaps."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.steering.georeference import Fix
from uw_dslam_ros2.core.metrics import interpolate_poses
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

__all__ = ["fixes_along"]

FloatArray = NDArray[np.float64]

_APART_NS = 10_000_000_000
"""Fixes that follow sooner err alike, and together say no more than the surest of them."""


def fixes_along(
    submaps: Iterable[Submap],
    stamps_ns: NDArray[np.int64],
    positions: FloatArray,
    sigmas_m: FloatArray,
    earth_frame: str,
) -> list[Fix]:
    """Fixes of one vehicle's submaps, in order of time, one for each ten seconds at most.

    Parameters
    ----------
    submaps
        Of that vehicle.
    stamps_ns
        (N,) of each position.
    positions
        (N, 2) [m] of base_link in `earth_frame`.
    sigmas_m
        (N,) standard deviation in x and y each.
    earth_frame
        Name of the coordinates.
    """
    stamps_ns = np.asarray(stamps_ns)
    found: dict[int, Fix] = {}
    for submap in sorted(submaps, key=lambda s: s.submap_id):
        if len(submap.trajectory) == 0:
            continue
        poses, is_inside = interpolate_poses(
            (submap.trajectory_stamp_ns, submap.trajectory), stamps_ns
        )
        for index in np.flatnonzero(is_inside).tolist():
            x_m, y_m, _ = poses[index].tolist()
            place = SE2(*np.asarray(positions[index], dtype=np.float64).tolist())
            # At a seam two submaps have it: the later one's word counts.
            found[index] = Fix(
                submap.submap_id, (x_m, y_m), place, float(sigmas_m[index]), math.inf, earth_frame
            )
    kept: list[Fix] = []
    spans = (stamps_ns - stamps_ns.min(initial=0)) // _APART_NS if len(stamps_ns) else stamps_ns
    for span in np.unique(spans[sorted(found)]).tolist():
        own = [i for i in np.flatnonzero(spans == span).tolist() if i in found]
        kept.append(found[min(own, key=lambda i: (found[i].sigma_m, stamps_ns[i], i))])
    return kept
