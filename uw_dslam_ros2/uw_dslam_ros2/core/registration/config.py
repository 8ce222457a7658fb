"""Settings of the registration of point sets."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.config import Config, setting

__all__ = ["RegistrationConfig"]


@dataclass(frozen=True, slots=True)
class RegistrationConfig(Config):
    """How two point sets are matched.

    ``method`` "likelihood" searches the logarithm of a likelihood ratio (each point has a partner
    or is clutter) with several kernels, and estimates noise and clutter share; "gmrbnb" is the
    paper's: plain sum of Gaussians, inliers by nearest-neighbour density, second search. The
    defaults of ``nnde_neighbors`` and ``nnde_threshold`` are from ``study nnde --sweep``; what
    they are worth on other seeds stands in docs/experiments.md.
    """

    method: str = setting(
        "likelihood", choices=("likelihood", "gmrbnb"), doc="objective that is searched"
    )
    sigma: float = setting(
        0.0, 0.0, 1.0e4, "standard deviation of each point's Gaussian [m]; 0: derived from spacing"
    )
    gap: float = setting(0.01, 1.0e-6, 0.9, "relative gap between the bounds to prove")
    max_boxes: int = setting(5_000_000, 1, 1_000_000_000, "boxes after which a search gives up")
    max_seconds: float = setting(
        0.0, 0.0, 1.0e6, "time after which a match gives up [s]; 0: no limit"
    )
    max_memory_mb: float = setting(
        512.0, 1.0, 1.0e6, "memory of the field tables and open boxes [MB]"
    )
    clutter_share: float = setting(
        0.5, 0.01, 0.99, "share of source points without partner that the search assumes"
    )
    min_points: int = setting(4, 2, 1000, "fewer points on either side are refused")
    min_posterior: float = setting(
        0.95, 0.5, 0.999999, "least posterior of an accepted pose, against chance and other poses"
    )
    max_rivals: int = setting(8, 0, 1000, "other poses reported")
    nnde_neighbors: int = setting(
        5, 1, 50, "K: neighbours in the other set whose mean distance gives a point's density"
    )
    nnde_threshold: float = setting(
        0.2, 0.0, 1.0, "normalised density above which a point is an inlier"
    )
