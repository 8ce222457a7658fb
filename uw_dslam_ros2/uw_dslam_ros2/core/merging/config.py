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
        "", doc="vehicle whose first submap pins the global frame; empty: the first that arrives"
    )
    resolution_m: float = setting(
        0.0, 0.0, 10.0, "cell size of the global map [m]; 0: that of the pinning submap"
    )
    log_odds_max: float = setting(8.0, 0.5, 50.0, "limit of the global map's log-odds")
    max_submap_cells: int = setting(
        16_000_000, 1, 2_000_000_000, "largest submap grid taken [cells]"
    )
    max_partners: int = setting(
        4, 1, 1000, "whole-map searches asked at once per vehicle, most promising first"
    )
    inlier_probability: float = setting(
        0.999, 0.5, 0.999999, "share of right edges that the chi-square test of an edge keeps"
    )
    edge_sigma_floor_m: float = setting(
        0.05, 0.0, 10.0, "least standard deviation believed of a registration [m]"
    )
    edge_sigma_floor_rad: float = setting(
        0.005, 0.0, 1.0, "least standard deviation believed of a registration [rad]"
    )
