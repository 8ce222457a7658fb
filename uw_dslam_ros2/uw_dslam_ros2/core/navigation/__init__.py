"""Dead reckoning from DVL, IMU and depth, with covariance."""

from uw_dslam_ros2.core.navigation.config import NavigationConfig
from uw_dslam_ros2.core.navigation.filter import FilterState, NavigationFilter

__all__ = ["FilterState", "NavigationConfig", "NavigationFilter"]
