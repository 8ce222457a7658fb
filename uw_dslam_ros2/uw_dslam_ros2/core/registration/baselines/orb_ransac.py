"""ORB features of two grids and RANSAC: how map-merging packages register maps."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, procrustes

__all__ = ["orb_ransac"]

FloatArray = NDArray[np.float64]

_UNKNOWN_GREY = 205


def orb_ransac(
    source: OccupancyMap,
    target: OccupancyMap,
    *,
    num_features: int = 2000,
    ratio: float = 0.8,
    reprojection_m: float = 0.2,
    min_inliers: int = 6,
    seed: int = 0,
) -> BaselineResult:
    """Register two occupancy maps of one resolution by their ORB features.

    Parameters
    ----------
    source, target : OccupancyMap
        Maps; the motion takes the source's frame to the target's.
    num_features : int
        ORB points per map.
    ratio : float
        A match counts when its distance is below this share of the second best's (Lowe's test).
    reprojection_m : float
        RANSAC's limit [m].
    min_inliers : int
        With fewer the motion is None.
    seed : int
        Of RANSAC's draws.

    Notes
    -----
    ``estimateAffinePartial2D`` fits a similarity. Its scale is thrown away: the motion is the
    least-squares *rigid* one of its inliers. The diagnostics tell the scale that it wanted.
    """
    if source.spec.resolution_m != target.spec.resolution_m:
        raise InvalidInputError(
            f"source has {source.spec.resolution_m} m per cell and target "
            f"{target.spec.resolution_m}, expected equal resolutions"
        )
    orb = cv2.ORB.create(nfeatures=num_features, fastThreshold=5)
    points_x, described_x = _features(orb, source)
    points_y, described_y = _features(orb, target)
    diagnostics = {"num_source": float(len(points_x)), "num_target": float(len(points_y))}
    if len(points_x) < 2 or len(points_y) < 2:
        return BaselineResult(None, 0.0, diagnostics)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(described_x, described_y, k=2)
    kept = [a for a, b in pairs if a.distance < ratio * b.distance]
    diagnostics["num_matches"] = float(len(kept))
    if len(kept) < min_inliers:
        return BaselineResult(None, 0.0, diagnostics)
    x = points_x[[match.queryIdx for match in kept]]
    y = points_y[[match.trainIdx for match in kept]]
    cv2.setRNGSeed(seed)
    similarity, mask = cv2.estimateAffinePartial2D(
        x, y, method=cv2.RANSAC, ransacReprojThreshold=reprojection_m, maxIters=5000
    )
    if similarity is None:
        return BaselineResult(None, 0.0, diagnostics)
    is_inlier = mask.ravel().astype(bool)
    diagnostics["scale"] = float(np.hypot(similarity[0, 0], similarity[1, 0]))
    if is_inlier.sum() < min_inliers:
        return BaselineResult(None, float(is_inlier.sum()), diagnostics)
    T_target_source = procrustes(x[is_inlier], y[is_inlier])
    return BaselineResult(T_target_source, float(is_inlier.sum()), diagnostics)


def _features(orb: cv2.ORB, grid: OccupancyMap) -> tuple[FloatArray, NDArray[np.uint8] | None]:
    """Feature points (N, 2) [m] in the map's frame, and their descriptors."""
    values = grid.values.astype(np.int16)
    image = np.where(values < 0, _UNKNOWN_GREY, 255 - values * 255 // 100).astype(np.uint8)
    keypoints, descriptors = orb.detectAndCompute(image, None)
    # Pixel centres are whole numbers in an image; here they lie at +0.5 cells.
    cells = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    return grid.spec.T_frame_grid.apply(cells * grid.spec.resolution_m), descriptors
