"""Certified registration of point sets and maps.

Names are loaded when they are first used: a match of points does not wait for what maps need.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uw_dslam_ros2.core.registration.config import RegistrationConfig
    from uw_dslam_ros2.core.registration.grids.register import (
        GridRegistrationConfig,
        register_grids,
    )
    from uw_dslam_ros2.core.registration.points.register import register_point_sets
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

_HOMES = {
    "GridRegistrationConfig": "grids.config",
    "RegistrationConfig": "config",
    "register_grids": "grids.register",
    "register_point_sets": "points.register",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES.get(name, 'result')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
