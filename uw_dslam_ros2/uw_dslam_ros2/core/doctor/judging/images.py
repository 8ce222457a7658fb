"""What a sonar's images hold, told by their speckle."""

from __future__ import annotations

import math

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.samples.sample import PingSample

__all__ = ["judge_images"]

_MIN_SILENT_SHARE = 0.05


def judge_images(result: Examination, pings: PingSample) -> None:
    """Tell of images that hold something else than they are read as."""
    if pings.pixels == "power" and pings.pixels_read_as == "amplitude":
        _say_power(result)
    if pings.pixels == "decibel" and pings.pixels_read_as != "decibel":
        _say_decibels(result, pings.db_per_count)
    if pings.silent_share >= _MIN_SILENT_SHARE:
        _say_silent(result, pings)


def _say_power(result: Examination) -> None:
    result.tell(
        "sonar_power",
        "sonar",
        "its pixels vary as an echo's power does, not its amplitude: read as amplitude they "
        "give many false echoes (mapper.sonar.intensity: power)",
    )
    result.mended.add("sonar_power")
    result.sonar_changes["intensity"] = "power"


def _say_decibels(result: Examination, db_per_count: float) -> None:
    result.tell(
        "sonar_decibel",
        "sonar",
        "its pixels vary as much where they are dark as where they are bright, as the "
        "logarithm of an echo does: read as amplitude they show no echo (mapper.sonar."
        f"intensity: decibel, mapper.sonar.db_per_count: {db_per_count:.2g})",
    )
    result.mended.add("sonar_decibel")
    result.sonar_changes |= {
        "intensity": "decibel", "db_per_count": float(f"{db_per_count:.2g}"),
    }  # fmt: skip


def _say_silent(result: Examination, pings: PingSample) -> None:
    first, last = (abs(math.degrees(b)) for b in (pings.silent_rad[0], pings.silent_rad[-1]))
    sides = ["starboard" if b < 0.0 else "port" for b in pings.silent_rad]
    where = f"between {first:.0f} degrees to {sides[0]} and {last:.0f} to {sides[-1]}"
    result.tell(
        "sonar_silent_beams",
        "sonar",
        f"{100.0 * pings.silent_share:.0f} % of its beams, {where}, never hold anything, while "
        "all others hold at least noise: these receivers are dead, covered, or left out by the "
        "driver; nothing is seen there, and water there does not count as free",
    )
