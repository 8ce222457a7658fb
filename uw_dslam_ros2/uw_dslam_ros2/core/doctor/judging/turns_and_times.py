"""What is said of who turns the other way, and whose clock is late."""

from __future__ import annotations

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.motions.delays import Delays, late_in_words
from uw_dslam_ros2.core.doctor.motions.fits import SURE, TurnFit, confidence_of

__all__ = ["say_delays", "say_one_flipped"]


def say_one_flipped(
    result: Examination, rates: int, orientation: int, fits: list[TurnFit]
) -> None:
    """Tell which of an IMU's rates and orientation turns against the other and the echoes."""
    sure = confidence_of(fits[0], fits[1])
    if orientation < 0:
        result.tell(
            "imu_ned",
            "imu",
            "its yaw turns against its own rates and against the sonar's echoes: it is a "
            "heading that grows clockwise, as in NED (conventions.imu_orientation: ned)",
            sure,
            imu_orientation="ned",
        )
    if rates < 0:
        result.tell(
            "imu_rates_frd",
            "imu",
            "its rates turn against its own yaw and against the sonar's echoes: their z axis "
            "points down (conventions.imu_rates: frd)",
            sure,
            imu_rates="frd",
        )


def say_delays(result: Examination, delays: Delays) -> None:
    """Tell whose stamps are late, or early."""
    either = "" if delays.is_owner_known else "; or it is the {}, which the dvl does not tell"
    if delays.imu_s:
        # An orientation that is late by itself is put in time with the rates first.
        total_s = result.conventions.imu_delay_s + delays.imu_s
        result.tell(
            "imu_delay",
            "imu",
            f"its stamps are {late_in_words(delays.imu_s)} than those of sonar and dvl, by "
            f"how the echoes turn{either.format('sonar')} (conventions.imu_delay_s: "
            f"{total_s:.2f})",
            delays.confidence,
            imu_delay_s=round(total_s, 3),
        )
    if delays.sonar_s:
        result.tell(
            "sonar_delay",
            "sonar",
            f"its stamps are {late_in_words(delays.sonar_s)} than the imu's, by how both turn"
            f"{either.format('imu')} (conventions.sonar_delay_s: {delays.sonar_s:.2f})",
            delays.confidence,
            sonar_delay_s=round(delays.sonar_s, 3),
        )
    if delays.velocity_s:
        is_sure = delays.confidence > SURE
        result.tell(
            "velocity_delay",
            "velocity",
            f"its stamps are {late_in_words(delays.velocity_s)} than those of sonar and imu, "
            f"by how the echoes move (conventions.velocity_delay_s: {delays.velocity_s:.2f})",
            delays.confidence,
            **({"velocity_delay_s": round(delays.velocity_s, 3)} if is_sure else {}),
        )
