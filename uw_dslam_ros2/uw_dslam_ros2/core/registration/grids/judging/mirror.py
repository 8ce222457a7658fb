"""What the source seen in a mirror would say: as much as this pair of maps reaches by accident.

In a mirror the same walls stand at the same distances, but no pose is right. So the best pose
there is a decoy: what is no more convincing than it, accident explains as well.
"""

from __future__ import annotations

from dataclasses import replace

from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.finding.candidates import scan_candidates
from uw_dslam_ros2.core.registration.grids.finding.search import whole_plane
from uw_dslam_ros2.core.registration.grids.judging.evidence import Found, Judge, refine
from uw_dslam_ros2.core.registration.grids.judging.probability import pose_logit
from uw_dslam_ros2.core.registration.grids.preparation import (
    Sides,
    in_a_mirror,
    make_levels,
    on_cells_of,
)
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid

__all__ = ["add_mirror_image"]

_NUM_PEAKS = 40  # a decoy worth a doubt stands out
_NUM_REFINED = 6


def add_mirror_image(
    found: Found, scales: list[Sides], pyramid: Pyramid, config: GridRegistrationConfig
) -> Found:
    """Evidence with the best pose of the source in a mirror, on the cells that decided."""
    source, target = on_cells_of(scales, pyramid.finest.resolution_m)
    mirrored = make_levels(in_a_mirror(source), target, config)
    candidates, background = scan_candidates(mirrored, whole_plane(mirrored.scanned), _NUM_PEAKS)
    source, target = found.judge.sides
    judge = Judge((in_a_mirror(source), target), mirrored, background)
    volume = found.evidence.log_volume
    best = max(
        (judge.evidence(candidate) for candidate in refine(mirrored, candidates, _NUM_REFINED)),
        key=lambda pose: pose_logit(pose, volume),
    )
    return replace(found, evidence=replace(found.evidence, decoy=best))
