"""The baselines as one table, each with the settings that suit a known noise and overlap."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.baselines.correlative import correlative
from uw_dslam_ros2.core.registration.baselines.go_icp import go_icp
from uw_dslam_ros2.core.registration.baselines.icp import icp, many_start_icp
from uw_dslam_ros2.core.registration.baselines.ndt import ndt
from uw_dslam_ros2.core.registration.baselines.pair_voting import pair_voting
from uw_dslam_ros2.core.registration.baselines.peers import available_peers
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult

__all__ = ["PointMatcher", "point_baselines"]

PointMatcher = Callable[[NDArray[np.float64], NDArray[np.float64]], BaselineResult]


def point_baselines(noise_m: float = 0.0, common_share: float = 1.0) -> dict[str, PointMatcher]:
    """Every baseline for points, told what nobody tells the engine: the noise and the overlap.

    Parameters
    ----------
    noise_m : float
        Standard deviation [m] of the coordinates' noise; kernels and tolerances follow it.
    common_share : float
        Share of the source that has a counterpart, which Go-ICP's trimming needs.
    """
    polish_m = max(0.05, 2.5 * noise_m)
    matchers: dict[str, PointMatcher] = {
        "ICP": icp,
        "NDT": ndt,
        "ICP, 36 starts": partial(many_start_icp, last_cutoff_m=polish_m),
        "correlative BnB": partial(
            correlative,
            kernel_m=max(0.02, noise_m),
            pitch_m=max(0.02, 0.6 * noise_m),
            polish_m=polish_m,
        ),
        "pair voting": partial(
            pair_voting, tolerance_m=max(0.02, 1.5 * noise_m), polish_m=polish_m
        ),
        "Go-ICP in SE(2)": partial(go_icp, trim=1.0 - common_share, max_rotations=500),
    }
    return matchers | available_peers()
