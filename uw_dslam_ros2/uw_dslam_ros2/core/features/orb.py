"""ORB keypoints of an occupancy map, on walls and away from the edge of what is known.

The paper's section 3.2 and Algorithm 1, line 2; keypoints only, since Gaussian mixtures match
positions and not descriptors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import FilteredCells

__all__ = ["orb_points"]

FloatArray = NDArray[np.float64]
_WALL_RADIUS_CELLS = 2
_FREE_GREY, _UNKNOWN_GREY, _WALL_GREY = 255, 205, 0


def orb_points(cells: FilteredCells, max_points: int) -> tuple[FloatArray, FloatArray]:
    """At most ``max_points`` keypoints [x, y] (N, 2) in cells, and weights (N,) of sum 1.

    Keypoints of all scales of the pyramid count if a wall lies within two cells and free space
    was seen beside it; those on the edge between known and unknown tell about the vehicle's path,
    not about the place. Weights are the corner responses, limited to twice their median.
    """
    import cv2  # large, so loaded when first used

    image = np.full(cells.shape, _UNKNOWN_GREY, np.uint8)
    image[cells.free > 0.5] = _FREE_GREY
    is_wall = cells.wall > 0.25
    image[is_wall] = _WALL_GREY
    # Without levels larger than the map; ORB's border is 31 pixels wide unless told otherwise.
    detector = cv2.ORB.create(
        nfeatures=4 * max_points, scaleFactor=1.2, nlevels=8, edgeThreshold=5, fastThreshold=10
    )
    found = detector.detect(image, _near(is_wall).astype(np.uint8) * 255)
    found = sorted(found, key=lambda point: (-point.response, point.pt))[:max_points]
    if not found:
        return np.empty((0, 2)), np.empty(0)
    # OpenCV counts from the middle of the first pixel.
    points = np.array([point.pt for point in found], dtype=np.float64) + 0.5
    response = np.array([max(point.response, 1e-12) for point in found])
    weights = np.minimum(response, 2.0 * float(np.median(response)))
    return points, weights / weights.sum()


def _near(is_wall: NDArray[np.bool_]) -> NDArray[np.bool_]:
    import cv2  # large, so loaded when first used

    size = 2 * _WALL_RADIUS_CELLS + 1
    return cv2.dilate(is_wall.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
