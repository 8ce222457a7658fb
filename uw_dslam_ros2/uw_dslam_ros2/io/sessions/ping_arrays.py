"""Kept pings as arrays, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["arrays_of_pings", "pings_of_arrays"]

_UNKNOWN = np.full(3, np.nan)
"""A pose."""


def arrays_of_pings(pings: Sequence[DrawnPing]) -> dict[str, NDArray[Any]]:
    """Named arrays of pings, in their order."""
    return {
        "stamp_ns": np.array([p.stamp_ns for p in pings], np.int64),
        "T_submap_sonar": np.array([p.T_submap_sonar.as_array() for p in pings]),
        "T_dead_sonar": np.array(
            [_UNKNOWN if p.T_dead_sonar is None else p.T_dead_sonar.as_array() for p in pings]
        ),
        "beamwidth_rad": np.array([p.beamwidth_rad for p in pings]),
        "range_sigma_m": np.array([p.range_sigma_m for p in pings]),
        "num_points": np.array([len(p.points) for p in pings], np.int64),
        "points": np.vstack([np.empty((0, 2), np.float32), *(p.points for p in pings)]),
        "weight": np.concatenate([np.empty(0, np.float32), *(p.weight for p in pings)]),
        "num_beams": np.array([len(p.free_range_m) for p in pings], np.int64),
        "free_range_m": np.concatenate(
            [np.empty(0, np.float32), *(p.free_range_m for p in pings)]
        ),
        "bearing_rad": np.concatenate([np.empty(0), *(p.bearing_rad for p in pings)]),
    }


def pings_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> list[DrawnPing]:
    """Pings again."""
    points, beams = (np.cumsum(arrays[name])[:-1] for name in ("num_points", "num_beams"))
    # Files of before do not have it.
    dead_reckoning = arrays.get("T_dead_sonar", np.full((len(arrays["stamp_ns"]), 3), np.nan))
    pings: list[DrawnPing] = []
    for stamp_ns, place, dead, beamwidth_rad, sigma_m, xy, weight, free_m, bearing_rad in zip(
        arrays["stamp_ns"].tolist(),
        arrays["T_submap_sonar"],
        dead_reckoning,
        arrays["beamwidth_rad"].tolist(),
        arrays["range_sigma_m"].tolist(),
        np.split(arrays["points"], points),
        np.split(arrays["weight"], points),
        np.split(arrays["free_range_m"], beams),
        np.split(arrays["bearing_rad"], beams),
        strict=False,  # of no ping at all there is one empty part
    ):
        if pings and np.array_equal(pings[-1].bearing_rad, bearing_rad):
            bearing_rad = pings[-1].bearing_rad  # as `pack_ping` does
        pings.append(
            DrawnPing(
                stamp_ns,
                SE2.from_array(place),
                xy,
                weight,
                bearing_rad,
                free_m,
                beamwidth_rad,
                sigma_m,
                None if np.isnan(dead).any() else SE2.from_array(dead),
            )
        )
    return pings
