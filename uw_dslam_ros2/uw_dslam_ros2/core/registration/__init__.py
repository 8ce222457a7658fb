"""Certified registration of point sets and maps."""

from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.grids import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.pipeline import register_point_sets
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    Progress,
    RegistrationResult,
    Rival,
    Verdict,
)

__all__ = [
    "GridRegistrationConfig",
    "PriorWindow",
    "Progress",
    "RegistrationConfig",
    "RegistrationResult",
    "Rival",
    "Verdict",
    "register_grids",
    "register_point_sets",
]
