"""Settings of one vehicle's mapping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.navigation.config import NavigationConfig
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.sonar.config import SonarConfig

__all__ = [
    "WIDE_BEAM_RAD",
    "LoopConfig",
    "MatchConfig",
    "OccupancyConfig",
    "ParticleConfig",
    "SubmapConfig",
    "VehicleMapperConfig",
]


WIDE_BEAM_RAD = 0.021
"""Wider beams leave gaps between the echoes of a wall."""
_USUAL_RANGE_M = 16.0
_SIGMA_M, _SHARE = 0.12, 0.1
_RELATED_RAD = 0.087
"""Echoes of beams nearer than five degrees err together: ten of a fan, three of a turn."""


@dataclass(frozen=True, slots=True)
class OccupancyConfig(Config):
    """The grid and the sonar's inverse sensor model."""

    resolution_m: float = setting(
        0.05, 0.01, 10.0, "cell size of the map [m]; coarser where the sonar is", is_basic=True
    )
    hit_log_odds: float = setting(
        0.7, 0.01, 10.0, "log-odds that a strong echo adds to a wall's face"
    )
    free_log_odds: float = setting(
        0.15, 0.001, 10.0, "log-odds of free water before the first echo, taken off"
    )
    log_odds_max: float = setting(4.0, 0.5, 20.0, "limit of a cell's log-odds")
    free_margin_m: float = setting(
        0.15, 0.0, 10.0, "water this close before an echo stays unknown [m]"
    )
    free_range_max_m: float = setting(30.0, 0.1, 1e4, "no free water is seen farther away [m]")


@dataclass(frozen=True, slots=True)
class SubmapConfig(Config):
    """When a submap closes: whichever comes first."""

    max_length_m: float = setting(
        25.0, 0.5, 1e4, "path length after which a submap closes [m]", is_basic=True
    )
    max_duration_s: float = setting(120.0, 1.0, 1e5, "time after which a submap closes [s]")
    max_sigma_m: float = setting(
        0.5, 0.01, 1e3, "uncertainty of the position within a submap that closes it [m]"
    )
    min_pings: int = setting(3, 1, 10000, "no submap closes with fewer pings (but the last)")


@dataclass(frozen=True, slots=True)
class MatchConfig(Config):
    """Scan-to-submap matching."""

    sigma_m: float = setting(
        0.0,
        0.0,
        10.0,
        "width of the likelihood field: noise of an echo [m]; 0: 0.12, or what the spacing of "
        "wide beams (a sonar that turns) leaves open",
    )
    key_distance_m: float = setting(
        1.0, 0.0, 100.0, "a ping is matched after this path length [m] ..."
    )
    key_turn_rad: float = setting(0.15, 0.0, 3.2, "... or this turn [rad] ...")
    key_interval_s: float = setting(5.0, 0.0, 1e4, "... or this time [s]")
    window_m: float = setting(2.0, 0.05, 100.0, "search at most this far from dead reckoning [m]")
    window_rad: float = setting(0.15, 0.001, 3.2, "search at most this far from its yaw [rad]")
    local_length_m: float = setting(
        15.0, 0.1, 1e4, "path length whose echoes a ping is matched against [m]"
    )
    information_share: float = setting(
        0.0,
        0.0,
        1.0,
        "independent information per echo: neighbouring echoes err together; 0: 0.1, more for "
        "wide beams",
    )

    def suited(self, beamwidth_rad: float) -> MatchConfig:
        """Settings with what was left to the sonar filled in, by its beams' spacing."""
        is_wide = beamwidth_rad >= WIDE_BEAM_RAD
        sigma_m = max(_SIGMA_M, 0.5 * beamwidth_rad * _USUAL_RANGE_M) if is_wide else _SIGMA_M
        share = min(1.0, beamwidth_rad / _RELATED_RAD) if is_wide else _SHARE
        return replace(
            self,
            sigma_m=self.sigma_m or sigma_m,
            information_share=self.information_share or share,
        )


@dataclass(frozen=True, slots=True)
class LoopRegistrationConfig(GridRegistrationConfig):
    """How the registration engine judges two submaps of one vehicle, near a guess.

    The proof matters less here than the verdict: the window is small and many pairs are tried.
    """

    may_be_mirrored: ClassVar[bool] = False  # both are drawn by the same conventions

    max_boxes: int = setting(20_000, 1000, 1_000_000_000, "boxes before the proof is given up")
    max_seconds: float = setting(
        20.0, 0.1, 3600.0, "not used: a map does not depend on how fast the machine is"
    )
    is_proof_required: bool = setting(
        False, doc="refuse a match, however probable, that is not the proven optimum to the gap"
    )
    max_false_accept: float = setting(
        0.25, 0.0, 1.0, "most probability that an accepted match is wrong"
    )


@dataclass(frozen=True, slots=True)
class LoopConfig(Config):
    """Loop closures between a vehicle's own submaps, and its pose graph."""

    is_enabled: bool = setting(True, doc="close loops inside the vehicle")
    max_candidates: int = setting(4, 0, 1000, "earlier submaps tried for each new one")
    registration: LoopRegistrationConfig = setting(LoopRegistrationConfig())


@dataclass(frozen=True, slots=True)
class ParticleConfig(Config):
    """The particle filter; where it looks for known submaps the settings of loops say."""

    num_particles: int = setting(60, 2, 10000, "particles")
    seed: int = setting(0, 0, 2**31 - 1, "same seed and same messages, same map")


@dataclass(frozen=True, slots=True)
class VehicleMapperConfig(Config):
    """Everything that one vehicle's mapping needs to know."""

    estimator: str = setting(
        "scan_matching",
        choices=("dead_reckoning", "scan_matching", "particle_filter"),
        doc="who places the pings: dead reckoning alone, scan matching with loop closures in a "
        "graph of submaps, or scan matching with a particle filter over submaps",
    )
    max_gap_s: float = setting(
        10.0,
        1.0,
        1e6,
        "longest silence of the heading, or of the velocity of a vehicle that may go over 4 m in "
        "it unseen, that is bridged [s]; after a longer one a new run begins",
    )
    sonar: SonarConfig = setting(SonarConfig())
    navigation: NavigationConfig = setting(NavigationConfig())
    occupancy: OccupancyConfig = setting(OccupancyConfig())
    submap: SubmapConfig = setting(SubmapConfig())
    match: MatchConfig = setting(MatchConfig())
    loop: LoopConfig = setting(LoopConfig())
    particles: ParticleConfig = setting(ParticleConfig())

    def suited(self, beamwidth_rad: float) -> VehicleMapperConfig:
        """Settings with what was left to the sonar filled in, by its beams' spacing [rad]."""
        return replace(self, match=self.match.suited(beamwidth_rad))
