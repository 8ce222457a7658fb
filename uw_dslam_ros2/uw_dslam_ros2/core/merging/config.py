"""Settings of the map queue."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.config import Config, setting

__all__ = ["MapQueueConfig"]


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
    log_odds_max: float = setting(8.0, 0.5, 50.0, "limit of the global map's log-odds")
    max_submap_cells: int = setting(
        16_000_000, 1, 2_000_000_000, "largest submap grid taken [cells]"
    )
    max_partners: int = setting(
        4, 1, 1000, "vehicles that each vehicle is matched with at first, most promising first"
    )
    num_neighbours: int = setting(
        1, 0, 100, "neighbours on each side that a submap is matched with in a check"
    )
    max_checks: int = setting(
        3, 0, 100, "checks of an accepted match, at different places of the common area"
    )
    part_length: int = setting(
        6, 2, 1000, "consecutive submaps in a part of a vehicle's map that is matched by itself"
    )
    max_part_searches: int = setting(
        4, 1, 1000, "searches between two components by their most promising parts"
    )
    vague_cells: float = setting(
        2.0, 0.1, 1e6, "places that saw the same are matched if less sure of each other [cells]"
    )
    vague_share: float = setting(
        1.0, 0.0, 100.0, "at most so many such matches for each submap, on average"
    )
    growth: float = setting(
        1.5,
        1.0,
        100.0,
        "while maps grow, refused ones are matched again when larger by this factor",
    )
    inlier_probability: float = setting(
        0.99, 0.5, 0.999999, "share of right edges that the chi-square test of an edge keeps"
    )
    edge_sigma_cells: float = setting(
        0.25, 0.0, 100.0, "least standard deviation believed of a registration [cells]"
    )
