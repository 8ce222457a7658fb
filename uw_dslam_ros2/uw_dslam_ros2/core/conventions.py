"""What a recording means by its numbers, where that is not what its messages' types say."""

from __future__ import annotations

from dataclasses import dataclass, fields

from uw_dslam_ros2.core.config import Config, setting

__all__ = ["Conventions"]


@dataclass(frozen=True, slots=True)
class Conventions(Config):
    """Corrections between what the instruments' drivers wrote and what their messages mean.

    With the defaults nothing is changed. ``doctor`` finds these and writes them down.
    """

    imu_orientation: str = setting(
        "enu",
        choices=("enu", "ned", "wxyz", "none"),
        doc="orientation of the IMU: enu (of a forward-left-up body in east-north-up, as ROS has "
        "it), ned (of a forward-right-down body in north-east-down), wxyz (enu, but with w in "
        "the field x and so on) or none (it says nothing)",
    )
    imu_rates: str = setting(
        "flu",
        choices=("flu", "frd", "none"),
        doc="axes of its rates: flu (forward, left, up), frd (forward, right, down) or none "
        "(never filled)",
    )
    imu_rates_in_degrees: bool = setting(False, doc="its rates are in degrees per second")
    imu_delay_s: float = setting(
        0.0, -1e6, 1e6, "how much later than true the IMU's stamps are [s]"
    )
    imu_roll_rad: float = setting(
        0.0, -3.2, 3.2, "turns the IMU on its mounting about the vehicle's forward axis [rad]"
    )
    imu_pitch_rad: float = setting(
        0.0, -3.2, 3.2, "turns it then about the vehicle's axis to port [rad]"
    )
    imu_drift_rad_s: float = setting(
        0.0,
        -0.1,
        0.1,
        "how fast its heading and its rates turn of their own, counter-clockwise seen from above "
        "[rad/s]",
    )
    imu_drift_since_s: float = setting(
        0.0, 0.0, 1e11, "stamp from which on the heading drifts [s]; what it is then is kept"
    )
    velocity_yaw_offset_rad: float = setting(
        0.0, -3.2, 3.2, "turns the measured velocity, counter-clockwise seen from above [rad]"
    )
    velocity_is_mirrored: bool = setting(
        False, doc="the velocity's sideways axis has the wrong sign; set right before it is turned"
    )
    velocity_axes: str = setting(
        "vehicle",
        choices=("vehicle", "world"),
        doc="axes of the velocity: the vehicle's, or the world's, which do not turn with it; then "
        "the IMU's heading turns it back, and velocity_yaw_offset_rad says how they lie to it",
    )
    velocity_scale: float = setting(1.0, 1e-4, 1e4, "factor on the measured velocity")
    velocity_zero_is_invalid: bool = setting(
        False, doc="a velocity of exactly zero means that there was none (no bottom lock)"
    )
    velocity_delay_s: float = setting(
        0.0, -1e6, 1e6, "how much later than true the velocity's stamps are [s]"
    )
    odometry: str = setting(
        "enu",
        choices=("enu", "ned"),
        doc="poses of the vehicle's own filter: enu (x east or ahead, y to the left of x, z up), "
        "or ned (north, east, down)",
    )
    sonar_is_mirrored: bool = setting(False, doc="port and starboard of the sonar are exchanged")
    sonar_yaw_offset_rad: float = setting(
        0.0, -3.2, 3.2, "turns the echoes about the sonar, counter-clockwise seen from above [rad]"
    )
    sonar_knocked_at_s: float = setting(
        0.0, 0.0, 1e11, "stamp from which on the sonar sits turned on its mounting [s]; 0: never"
    )
    sonar_knocked_yaw_rad: float = setting(
        0.0, -3.2, 3.2, "by how much it is turned then, counter-clockwise seen from above [rad]"
    )
    sonar_range_scale: float = setting(1.0, 0.1, 10.0, "factor on the ranges (sound speed)")
    sonar_bearing_scale: float = setting(
        1.0, 0.2, 5.0, "factor on the bearings of images and scans (the aperture is wrong)"
    )
    sonar_delay_s: float = setting(
        0.0, -1e6, 1e6, "how much later than true the sonar's stamps are [s]"
    )

    def changes(self) -> dict[str, str | float | bool]:
        """Those that differ from the defaults."""
        return {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if getattr(self, f.name) != f.default
        }
