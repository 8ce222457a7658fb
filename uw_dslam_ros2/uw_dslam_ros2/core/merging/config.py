"""Settings of the map queue, and constants that its parts share."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.config import Config, setting

__all__ = [
    "INLIER_PROBABILITY",
    "LOG_ODDS_MAX",
    "MAX_CHECKS",
    "MAX_MAP_CELLS",
    "NUM_NEIGHBOURS",
    "VAGUE_CELLS",
    "MapQueueConfig",
]

NUM_NEIGHBOURS = 1
"""Submaps on each side that one is matched with in a check: a single one shares too little."""
MAX_CHECKS = 3
"""Checks of an accepted match, at different places: two may fail by chance, three rarely do."""
VAGUE_CELLS = 2.0
"""Places that saw the same are matched where they are less sure of each other [cells]: what is
surer than that does not show in the map.
"""
LOG_ODDS_MAX = 8.0
"""Limit of the log-odds of merged cells: twice that of a vehicle's own map, so that two that
agree are surer than one, and a third can still change it.
"""
MAX_MAP_CELLS = 100_000_000
INLIER_PROBABILITY = 0.99
"""Share of right edges that the chi-square test of an edge keeps."""


@dataclass(frozen=True, slots=True)
class MapQueueConfig(Config):
    """How submaps are matched, joined and fused."""

    mode: str = setting(
        "graph",
        doc="graph: best match first, pose graph over all; pairwise: the paper's queue of maps",
        choices=("graph", "pairwise"),
    )
    anchor_vehicle: str = setting(
        "",
        doc="vehicle whose first submap pins the global frame; empty: the first that is joined",
        is_basic=True,
    )
    resolution_m: float = setting(
        0.0,
        0.0,
        10.0,
        "cell size of the global map [m]; 0: that of the pinning submap",
        is_basic=True,
    )
    max_submap_cells: int = setting(
        16_000_000, 1, 2_000_000_000, "largest submap grid taken [cells]"
    )
    max_partners: int = setting(
        4, 1, 1000, "vehicles that each vehicle is matched with at first, most promising first"
    )
    max_speed_m_s: float = setting(
        10.0,
        0.1,
        1e4,
        "submaps of a run that its vehicle would have to be faster for are set aside [m/s]",
    )
    growth: float = setting(
        1.5,
        1.0,
        100.0,
        "while maps grow, refused ones are matched again when larger by this factor",
    )
