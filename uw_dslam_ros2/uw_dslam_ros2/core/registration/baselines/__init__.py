"""Other ways to register, behind one interface: ``(source, target) -> BaselineResult``.

They stand beside the engine in studies and benchmarks; nothing else calls them.
"""

from uw_dslam_ros2.core.registration.baselines.correlative import correlative
from uw_dslam_ros2.core.registration.baselines.go_icp import go_icp
from uw_dslam_ros2.core.registration.baselines.icp import icp, many_start_icp
from uw_dslam_ros2.core.registration.baselines.ndt import ndt
from uw_dslam_ros2.core.registration.baselines.orb_ransac import akaze_ransac, orb_ransac
from uw_dslam_ros2.core.registration.baselines.pair_voting import pair_voting
from uw_dslam_ros2.core.registration.baselines.peers import PEERS, available_peers
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, procrustes
from uw_dslam_ros2.core.registration.baselines.spectra import fourier_mellin, hough_spectrum
from uw_dslam_ros2.core.registration.baselines.suite import PointMatcher, point_baselines

__all__ = [
    "PEERS",
    "BaselineResult",
    "PointMatcher",
    "akaze_ransac",
    "available_peers",
    "correlative",
    "fourier_mellin",
    "go_icp",
    "hough_spectrum",
    "icp",
    "many_start_icp",
    "ndt",
    "orb_ransac",
    "pair_voting",
    "point_baselines",
    "procrustes",
]
