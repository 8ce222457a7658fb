"""What the source seen in a mirror would say: as much as this pair of maps reaches by accident.

In a mirror the same walls stand at the same distances, but no pose is right. So the best pose
there is a decoy: what is no more convincing than it, accident explains as well.
"""

from __future__ import annotations

from dataclasses import replace

from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.finding.candidates import log_volume, scan_candidates
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
    """Evidence with the best pose of the source in a mirror, on the cells that decided.

    It is looked for in the whole plane, for a prior says nothing of where a map in a mirror lies.
    """
    source, target = on_cells_of(scales, pyramid.finest.resolution_m)
    mirrored = make_levels(in_a_mirror(source), target, config)
    plane = whole_plane(mirrored.scanned)
    candidates, background = scan_candidates(mirrored, plane, _NUM_PEAKS)
    source, target = found.judge.sides
    judge = Judge((in_a_mirror(source), target), mirrored, background)
    volume = log_volume(mirrored, plane)
    best = max(
        (judge.evidence(candidate) for candidate in refine(mirrored, candidates, _NUM_REFINED)),
        key=lambda pose: pose_logit(pose, volume),
    )
    evidence = replace(found.evidence, decoy=best, decoy_log_volume=volume)
    return replace(found, evidence=evidence)
