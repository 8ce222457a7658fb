"""The pose graph of a merge as a file for other programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from uw_dslam_ros2.core.merging import Constraint, SubmapRecord
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.trajectories import PoseGraphEdge, g2o_bytes, invertible

__all__ = ["pose_graph_bytes"]

_UNSURE_EDGE = "refused by itself; believed because others agree with it"


def pose_graph_bytes(
    records: Iterable[SubmapRecord],
    constraints: Iterable[Constraint],
    numbers: Mapping[SubmapId, int] | None = None,
) -> bytes:
    """Submaps that share a frame, and their edges but those that were found wrong, as g2o.

    Parameters
    ----------
    records
        Withdrawn ones belong to it: they are not drawn, but carry their run's odometry.
    constraints
        Those between other submaps do not count.
    numbers
        Of the vertices; None: in order, from 0.
    """
    poses = {record.submap.submap_id: record.T_component_submap for record in records}
    known = {i: k for k, i in enumerate(poses)} if numbers is None else numbers
    edges = [
        PoseGraphEdge(
            known[c.target],
            known[c.source],
            c.T_target_source,
            invertible(c.covariance),
            _UNSURE_EDGE if c.is_unsure else "",
        )
        for c in constraints
        if c.is_inlier and c.source in poses and c.target in poses
    ]
    return g2o_bytes({known[i]: pose for i, pose in poses.items()}, edges)
