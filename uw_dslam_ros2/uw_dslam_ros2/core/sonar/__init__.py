"""Sonar front end: images, scans or points to detections."""

from uw_dslam_ros2.core.sonar.clouds import Clouds
from uw_dslam_ros2.core.sonar.config import SonarConfig
from uw_dslam_ros2.core.sonar.detect import detect, detections_from_points, detections_from_scan
from uw_dslam_ros2.core.sonar.turning import BeamGatherer, Beams, PlacedSweep, place_sweep
from uw_dslam_ros2.core.sonar.types import Detections, SonarImage

__all__ = [
    "BeamGatherer",
    "Beams",
    "Clouds",
    "Detections",
    "PlacedSweep",
    "SonarConfig",
    "SonarImage",
    "detect",
    "detections_from_points",
    "detections_from_scan",
    "place_sweep",
]
