"""Settings of the sonar front end."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import ConfigError

__all__ = ["SonarConfig"]


@dataclass(frozen=True, slots=True)
class SonarConfig(Config):
    """How echoes are found in an image, and what an echo is worth.

    The stages run in this order: range gate (blanking), segmentation (`segmentation`), choice of
    returns in each beam (`returns`), distance-constrained filter (`neighbor_distance_m`; 0
    switches it off).
    """

    segmentation: str = setting(
        "cfar_soca",
        choices=("fixed", "adaptive", "cfar_ca", "cfar_soca"),
        doc="what counts as an echo: fixed threshold, threshold per range, constant false alarm "
        "rate along range",
    )
    intensity: str = setting(
        "amplitude",
        choices=("amplitude", "power", "decibel"),
        doc="what the image holds: amplitude (Rayleigh noise), power (exponential noise) or "
        "decibel (a logarithm)",
        is_basic=True,
    )
    db_per_count: float = setting(
        0.3, 1e-4, 1e3, "decibel: what one step of the pixels stands for [dB]"
    )
    fixed_threshold: float = setting(
        0.3, 0.0, 1.0, "fixed: share of full scale (integers: the type's largest value, floats: 1)"
    )
    min_threshold: float = setting(
        0.0, 0.0, 1.0, "adaptive and CFAR: share of full scale below which nothing is an echo"
    )
    adaptive_factor: float = setting(
        4.0, 0.5, 50.0, "adaptive: spreads above the median of the same range over all beams"
    )
    false_alarm_rate: float = setting(
        1e-4, 1e-12, 0.1, "CFAR: designed false alarms per cell of pure noise"
    )
    num_train_cells: int = setting(20, 2, 500, "CFAR: noise cells on each side")
    num_guard_cells: int = setting(
        4, 0, 500, "CFAR: cells left out on each side of the one under test"
    )
    returns: str = setting(
        "first", choices=("first", "strongest", "all"), doc="echoes kept in each beam"
    )
    min_separation_m: float = setting(
        0.3, 0.0, 100.0, "all: least distance of two echoes of one beam [m]"
    )
    min_range_m: float = setting(
        0.5, 0.0, 1000.0, "blanking: nothing nearer is an echo [m]", is_basic=True
    )
    max_range_m: float = setting(
        1000.0, 0.1, 10000.0, "range gate: nothing farther is an echo [m]", is_basic=True
    )
    neighbor_distance_m: float = setting(
        0.5,
        0.0,
        100.0,
        "an echo of a fan needs neighbours this near, or is dropped [m], beam spread added; 0: "
        "off, as for echoes that are filtered already and always for sonars that turn",
        is_basic=True,
    )
    min_neighbors: int = setting(
        2, 1, 100, "how many neighbours an echo needs within neighbor_distance_m"
    )
    beamwidth_rad: float = setting(
        0.0, 0.0, 1.0, "width of one beam in bearing [rad]; 0: as wide as the beams lie apart"
    )
    range_sigma_m: float = setting(
        0.03, 0.0001, 10.0, "standard deviation of a range, at least (a bin adds its own) [m]"
    )

    def __post_init__(self) -> None:
        Config.__post_init__(self)
        if self.max_range_m <= self.min_range_m:
            raise ConfigError(
                f"SonarConfig.max_range_m is {self.max_range_m}, expected more than min_range_m "
                f"= {self.min_range_m}"
            )
