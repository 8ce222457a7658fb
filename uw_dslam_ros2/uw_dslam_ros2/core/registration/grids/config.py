"""Settings of the registration of grids."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import ConfigError

__all__ = ["GridRegistrationConfig"]


# What method paper knows; the rest is of walls and free space, and of the verdict on them.
_OF_PAPER = (
    "method", "features", "max_points", "max_side_cells", "gap", "max_boxes", "max_seconds",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class GridRegistrationConfig(Config):
    """How two occupancy maps are matched; "cells" are those of the finest level.

    Method paper judges points by the posterior of `RegistrationConfig`, always with a proof. So it
    refuses any other value than the default for what only the other method knows.
    """

    # Whether one map may have left and right exchanged against the other.
    may_be_mirrored: ClassVar[bool] = True

    method: str = setting(
        "signed",
        doc="signed: walls and free space, both ways; paper: mixture of points, one way",
        choices=("signed", "paper"),
    )
    features: str = setting("orb", doc="points of method paper", choices=("orb", "walls", "both"))
    sigma_cells: float = setting(1.0, 0.5, 5.0, "walls' kernel, in working cells")
    free_penalty: float = setting(0.7, 0.0, 2.0, "worth of a wall on free space, walls being 1")
    max_points: int = setting(200, 20, 5000, "wall points of each map in the search")
    working_cells: int = setting(65, 20, 400, "longer side of the larger map in the search")
    finest_cells: int = setting(1000, 100, 4000, "longer side of a map in the refinement")
    max_side_cells: int = setting(8000, 100, 100000, "maps with a longer side are refused")
    gap: float = setting(0.1, 0.001, 0.5, "relative gap of the certificate")
    max_boxes: int = setting(200_000, 1000, 1_000_000_000, "boxes before the proof is given up")
    max_seconds: float = setting(
        20.0, 0.1, 3600.0, "time for the proof [s]; needs a clock", is_basic=True
    )
    is_proof_required: bool = setting(
        False,
        doc="refuse a match, however probable, that is not the proven optimum to the gap",
        is_basic=True,
    )
    min_wall_cells: int = setting(25, 1, 100000, "fewer wall cells in a map are too few")
    min_overlap: float = setting(0.1, 0.0, 1.0, "least common seen area, share of the smaller")
    max_false_accept: float = setting(
        0.25, 0.0, 1.0, "most probability that an accepted match is wrong", is_basic=True
    )

    def __post_init__(self) -> None:
        Config.__post_init__(self)
        if self.method != "paper":
            return
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name not in _OF_PAPER and value != field.default:
                raise ConfigError(
                    f"{type(self).__name__}.{field.name} is {value}, expected {field.default}, "
                    "the default: method paper does not know this setting"
                )
