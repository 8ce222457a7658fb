"""A run's last pass: its submaps drawn once more, from its own pings where these agree best."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.bending import DRIFT_M, DRIFT_RAD
from uw_dslam_ros2.core.chart.drawing import SHARE_AGAINST, PingTrack, refined
from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.se2 import SE2, compose_poses, wrap_angle
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = ["drift_of", "moved_by", "redrawn"]

FloatArray = NDArray[np.float64]


def redrawn(
    submaps: Sequence[Submap],
    pings: Mapping[SubmapId, Sequence[DrawnPing]],
    config: OccupancyConfig,
) -> list[Submap]:
    """Submaps as their next revision: grid, path and pose by the run's refined path.

    Empty where nothing is kept.

    Parameters
    ----------
    submaps
        All of one run, in their order.
    pings
        What is kept of them. Submaps of which nothing is kept move with the one before them.
    config
        Grid and sensor model.
    """
    kept = [(submap, ping) for submap in submaps for ping in pings.get(submap.submap_id, ())]
    if not kept:
        return []
    poses = [(submap.T_odom_submap @ ping.T_submap_sonar).as_array() for submap, ping in kept]
    drift = drift_of(submaps)
    before = PingTrack(
        [ping for _, ping in kept],
        np.array(poses),
        np.array([drift[submap.submap_id] for submap, _ in kept]),
    )
    (after,) = refined([before], config.resolution_m)
    result, first, T_new_old = [], 0, SE2()
    for submap in submaps:
        own = slice(first, first + len(pings.get(submap.submap_id, ())))
        first = own.stop
        if own.start == own.stop:
            T_odom_submap = T_new_old @ submap.T_odom_submap
            result.append(_revised(submap, T_odom_submap))
            continue
        path = _placed(submap.T_odom_submap, submap.trajectory)
        moved = path + moved_by([before], [after], submap.trajectory_stamp_ns)
        # Its frame goes with the middle of its path, so that what lies in it moves least.
        middle = len(path) // 2
        T_new_old = SE2.from_array(moved[middle]) @ SE2.from_array(path[middle]).inverse()
        T_odom_submap = T_new_old @ submap.T_odom_submap
        T_submap_odom = T_odom_submap.inverse()
        grid = GrowingGrid(config, share_against=SHARE_AGAINST)
        for ping, pose in zip(after.pings[own], after.T_map_sonar[own], strict=True):
            T_submap_sonar = T_submap_odom @ SE2.from_array(pose)
            grid.add(ping.detections(after.range_scale), T_submap_sonar)
        result.append(
            dataclasses.replace(
                _revised(submap, T_odom_submap),
                grid=grid.trimmed().to_occupancy(config.log_odds_max),
                trajectory=_placed(T_submap_odom, moved),
            )
        )
        # What follows without pings goes on from its end.
        T_new_old = SE2.from_array(moved[-1]) @ SE2.from_array(path[-1]).inverse()
    return result


def moved_by(
    before: Sequence[PingTrack], after: Sequence[PingTrack], stamps_ns: NDArray[np.int64]
) -> FloatArray:
    """How poses (K, 3) of a vehicle change at any times, by how those of its runs' pings did.

    Between pings in proportion. The sonar's turn on the vehicle is no heading of that.
    """
    ping_ns = np.concatenate([track.stamps_ns for track in before])
    moved = np.vstack([_moved(*tracks) for tracks in zip(before, after, strict=True)])
    order = np.argsort(ping_ns, kind="stable")
    # Relative to the first: nanoseconds since 1970 do not fit a double.
    start_ns = int(ping_ns.min())
    at, known = stamps_ns - start_ns, ping_ns[order] - start_ns
    return np.column_stack([np.interp(at, known, column) for column in moved[order].T])


def _moved(before: PingTrack, after: PingTrack) -> FloatArray:
    moved = after.T_map_sonar - before.T_map_sonar
    moved[:, 2] = wrap_angle(moved[:, 2] - after.mounting_rad)
    return moved


def drift_of(submaps: Sequence[Submap]) -> dict[SubmapId, tuple[float, float]]:
    """What navigation says the path through each submap of a run gains on one metre.

    Standard deviations [m], [rad]. Where an instrument fell silent it is more than elsewhere;
    where nobody says, as much as in most.
    """
    known: dict[SubmapId, tuple[float, float]] = {}
    for before, after in itertools.pairwise(submaps):
        way_m = float(np.hypot(*np.diff(before.trajectory[:, :2], axis=0).T).sum())
        if after.sequence == before.sequence + 1 and way_m > 0.0:
            x, y, yaw = np.diag(after.covariance) / way_m
            known[before.submap_id] = math.sqrt(0.5 * (x + y)), math.sqrt(yaw)
    typical = (DRIFT_M, DRIFT_RAD)
    if known:
        drift_m, drift_rad = np.median(list(known.values()), axis=0)
        typical = float(drift_m), float(drift_rad)
    return {submap.submap_id: known.get(submap.submap_id, typical) for submap in submaps}


def _revised(submap: Submap, T_odom_submap: SE2) -> Submap:
    return dataclasses.replace(submap, revision=submap.revision + 1, T_odom_submap=T_odom_submap)


def _placed(T_frame_submap: SE2, poses: FloatArray) -> FloatArray:
    """Poses (K, 3) of a submap, in a frame where it lies."""
    return compose_poses(np.broadcast_to(T_frame_submap.as_array(), poses.shape), poses)
