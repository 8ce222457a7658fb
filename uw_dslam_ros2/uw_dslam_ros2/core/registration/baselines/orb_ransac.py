"""ORB or AKAZE features of two grids and RANSAC: how map-merging packages register maps."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, procrustes

__all__ = ["akaze_ransac", "orb_ransac"]

FloatArray = NDArray[np.float64]

_UNKNOWN_GREY = 205
_LEAST_MATCHES = 3  # for a motion at all


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
    orb = cv2.ORB.create(nfeatures=num_features, fastThreshold=5)
    found = _register(orb, source, target, ratio, reprojection_m, seed)
    return found if found.score >= min_inliers else replace(found, T_target_source=None)


def akaze_ransac(
    source: OccupancyMap,
    target: OccupancyMap,
    *,
    ratio: float = 0.7,
    reprojection_m: float = 0.2,
    min_confidence: float = 1.0,
    seed: int = 0,
) -> BaselineResult:
    """Register two occupancy maps of one resolution by their AKAZE features, as `orb_ransac`.

    A motion is given where inliers / (8 + 0.3 matches) exceeds ``min_confidence``: the rule of
    image stitching (Brown and Lowe 2007), by which map-merging packages accept.
    """
    found = _register(cv2.AKAZE.create(), source, target, ratio, reprojection_m, seed)
    confidence = found.score / (8.0 + 0.3 * found.diagnostics.get("num_matches", 0.0))
    return found if confidence > min_confidence else replace(found, T_target_source=None)


def _register(
    detector: cv2.Feature2D,
    source: OccupancyMap,
    target: OccupancyMap,
    ratio: float,
    reprojection_m: float,
    seed: int,
) -> BaselineResult:
    """The rigid motion of most matches, and as score how many they are."""
    if source.spec.resolution_m != target.spec.resolution_m:
        raise InvalidInputError(
            f"source has {source.spec.resolution_m} m per cell and target "
            f"{target.spec.resolution_m}, expected equal resolutions"
        )
    points_x, described_x = _features(detector, source)
    points_y, described_y = _features(detector, target)
    diagnostics = {"num_source": float(len(points_x)), "num_target": float(len(points_y))}
    if len(points_x) < 2 or len(points_y) < 2:
        return BaselineResult(None, 0.0, diagnostics)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(described_x, described_y, k=2)
    kept = [p[0] for p in pairs if len(p) == 2 and p[0].distance < ratio * p[1].distance]
    diagnostics["num_matches"] = float(len(kept))
    if len(kept) < _LEAST_MATCHES:
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
    if is_inlier.sum() < _LEAST_MATCHES:
        return BaselineResult(None, float(is_inlier.sum()), diagnostics)
    T_target_source = procrustes(x[is_inlier], y[is_inlier])
    return BaselineResult(T_target_source, float(is_inlier.sum()), diagnostics)


def _features(
    detector: cv2.Feature2D, grid: OccupancyMap
) -> tuple[FloatArray, NDArray[np.uint8] | None]:
    """Feature points (N, 2) [m] in the map's frame, and their descriptors."""
    values = grid.values.astype(np.int16)
    image = np.where(values < 0, _UNKNOWN_GREY, 255 - values * 255 // 100).astype(np.uint8)
    keypoints, descriptors = detector.detectAndCompute(image, None)
    # Pixel centres are whole numbers in an image; here they lie at +0.5 cells.
    cells = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    return grid.spec.T_frame_grid.apply(cells * grid.spec.resolution_m), descriptors
