"""What is wrong with a recording, by numbers alone."""

from uw_dslam_ros2.core.doctor.collector import SampleCollector
from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.examine import examine
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample, PingSample

__all__ = [
    "Examination",
    "NavigationSample",
    "PingSample",
    "SampleCollector",
    "examine",
]
