"""Settings of dead reckoning: how noisy the sensors are."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.config import Config, setting

__all__ = ["NavigationConfig"]


@dataclass(frozen=True, slots=True)
class NavigationConfig(Config):
    """Noise of the navigation sensors and of the vehicle's motion.

    Standard deviations, from the sensors' data sheets.
    """

    velocity_walk_m_s: float = setting(
        0.15, 1e-4, 10.0, "how much the velocity may change within a second [m/s]"
    )
    turn_walk_rad_s: float = setting(
        0.15, 1e-4, 10.0, "how much the yaw rate may change within a second [rad/s]"
    )
    velocity_sigma_m_s: float = setting(
        0.02, 1e-4, 10.0, "noise of a velocity whose message gives no covariance [m/s]"
    )
    velocity_scale_sigma: float = setting(
        0.005,
        0.0,
        1.0,
        "scale error of the velocity sensor (share): a DVL 0.005, velocity commands 0.2",
        is_basic=True,
    )
    current_sigma_m_s: float = setting(
        0.0,
        0.0,
        5.0,
        "speed of the water where velocity is measured or commanded against it [m/s]; 0 with "
        "bottom lock",
        is_basic=True,
    )
    current_time_s: float = setting(600.0, 1.0, 1e6, "time over which that current changes [s]")
    yaw_sigma_rad: float = setting(
        0.02, 1e-4, 3.0, "noise of a yaw whose message gives no variance [rad]", is_basic=True
    )
    heading_offset_sigma_rad: float = setting(
        0.02, 0.0, 3.0, "slow error of the yaw: deviation, steel nearby [rad]"
    )
    heading_offset_time_s: float = setting(
        200.0, 1.0, 1e6, "time over which that error changes [s]"
    )
    yaw_rate_sigma_rad_s: float = setting(0.01, 1e-5, 3.0, "noise of a yaw rate [rad/s]")
    gyro_bias_sigma_rad_s: float = setting(
        0.002, 0.0, 1.0, "bias of the yaw rate at the start [rad/s]"
    )
    gyro_bias_walk_rad_s: float = setting(
        2e-5, 0.0, 1.0, "how much that bias may change within a second [rad/s]"
    )
    gate_sigma: float = setting(
        4.0,
        1.0,
        100.0,
        "a measurement farther than this from what was expected is an outlier [sigma]",
    )
    gate_reset_s: float = setting(
        20.0,
        0.1,
        1e4,
        "a sensor refused for so long without a break is believed again, its error as noise [s]",
    )
    horizon_s: float = setting(
        3.0, 0.0, 60.0, "messages at most this late are put where they belong [s]"
    )
