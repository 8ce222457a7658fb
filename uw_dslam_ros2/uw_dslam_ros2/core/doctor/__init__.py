"""What is wrong with a recording, by numbers alone."""

from uw_dslam_ros2.core.doctor.collector import SampleCollector
from uw_dslam_ros2.core.doctor.examine import Examination, examine
from uw_dslam_ros2.core.doctor.sample import NavigationSample, PingSample

__all__ = [
    "Examination",
    "NavigationSample",
    "PingSample",
    "SampleCollector",
    "examine",
]
