"""How much longer or shorter the measured way is than the echoes say, and whose fault it is."""

from __future__ import annotations

import math

from uw_dslam_ros2.core.doctor.examination import Examination, ScaleEstimate
from uw_dslam_ros2.core.doctor.motions.fits import VelocityFit

__all__ = ["confidence_in", "is_scale_wrong", "judge_scale", "scale_of"]

_MIN_SCALE_ERROR = 0.019
_USUAL_SCALE_ERROR = 0.015
"""A DVL and a speed of sound that are as good as data sheets say disagree by less."""
_MIN_TILT_RAD = math.radians(5.0)  # from there on it costs more than instruments err
_UNIT_SCALE = 1.3
_UNIT_TOLERANCE = 0.025  # tells knots from half
_UNITS = {
    "millimetres per second": 1e-3, "centimetres per second": 1e-2, "knots": 0.5144,
    "kilometres per hour": 1.0 / 3.6, "feet per second": 0.3048,
}  # fmt: skip
_RANGE_FACTORS = (0.5, 2.0, 1.0 / 0.3048, 0.1, 10.0)
"""Of ranges there and back, or half of them; in feet; centimetres for millimetres, or decimetres.
"""
_MAX_RANGE_FACTOR = 5.0


def is_scale_wrong(fit: VelocityFit) -> bool:
    """Whether echoes and navigation disagree by more than good instruments do."""
    error = abs(fit.scale - 1.0)
    return error >= _MIN_SCALE_ERROR and error - 2.0 * fit.factor_sigma >= _USUAL_SCALE_ERROR


def scale_of(fit: VelocityFit, by: str) -> ScaleEstimate | None:
    """What a fit says of the scale; None where it is a unit that is wrong."""
    if _is_unit_wrong(fit.scale):
        return None
    return ScaleEstimate(fit.scale, fit.factor_sigma, by)


def _is_unit_wrong(scale: float) -> bool:
    """Whether a scale is farther from 1 than any water or calibration takes it."""
    return not 1.0 / _UNIT_SCALE < scale < _UNIT_SCALE


def judge_scale(result: Examination, fit: VelocityFit, tilt_rad: float = 0.0) -> None:
    """Tell of a DVL whose unit or scale, or a sonar whose speed of sound, is wrong.

    A large factor that is none of a DVL's units is the sonar's. Of a sonar that looks up or down
    by ``tilt_rad`` it is said that it does.
    """
    is_tilted = tilt_rad > _MIN_TILT_RAD
    if not is_tilted:
        result.scale = scale_of(fit, "velocity")
    if not is_scale_wrong(fit):
        return
    if _is_unit_wrong(fit.scale):
        _say_unit(result, fit.scale)
        return
    error = abs(fit.scale - 1.0)
    confidence = confidence_in(error - 0.5 * _MIN_SCALE_ERROR, fit.factor_sigma)
    if fit.scale < 1.0 and is_tilted:
        result.tell(
            "sonar_tilt",
            "sonar",
            f"it looks {math.degrees(tilt_rad):.0f} degrees up or down, and its echoes move "
            f"{100.0 * (1.0 - fit.scale):.1f} % less than the dvl says: tall beams meet a wall "
            "nearer than their middle does, by which they are projected "
            f"(conventions.sonar_range_scale: {1.0 / fit.scale:.3f}); mount it level where a true "
            "map is wanted",
            confidence,
            sonar_range_scale=round(1.0 / fit.scale, 4),
        )
        return
    # Only the ratio shows. Instruments are set for the sea, 1500 m/s; colder or fresher water
    # makes one that is not set for it measure too long, and hardly any water too short.
    if fit.scale > 1.0:
        result.tell(
            "sound_speed",
            "sonar",
            f"its echoes move {100.0 * (fit.scale - 1.0):.1f} % farther than the dvl says, as "
            "with a speed of sound that is too high for colder or fresher water "
            f"(conventions.sonar_range_scale: {1.0 / fit.scale:.3f}); or the dvl's scale is "
            f"too small (conventions.velocity_scale: {fit.scale:.3f} instead)",
            confidence,
            sonar_range_scale=round(1.0 / fit.scale, 4),
        )
        return
    result.tell(
        "dvl_scale",
        "velocity",
        f"its way is {100.0 * (1.0 / fit.scale - 1.0):.1f} % longer than the sonar's echoes "
        "move, as with a speed of sound that is too high for colder or fresher water "
        f"(conventions.velocity_scale: {fit.scale:.3f}); or the sonar's is too low "
        f"(conventions.sonar_range_scale: {1.0 / fit.scale:.3f} instead)",
        confidence,
        velocity_scale=round(fit.scale, 4),
    )


def _say_unit(result: Examination, scale: float) -> None:
    name, unit = min(_UNITS.items(), key=lambda item: _distance(scale, item[1]))
    plain = min(_RANGE_FACTORS, key=lambda factor: _distance(scale, factor))
    is_unit = _distance(scale, unit) < _UNIT_TOLERANCE
    is_plain = _distance(scale, plain) < _UNIT_TOLERANCE
    # A DVL measures in some unit; the length of a sonar's range bins is often set by hand.
    is_dvl = is_unit or not (is_plain or 1.0 / _MAX_RANGE_FACTOR < scale < _MAX_RANGE_FACTOR)
    if is_dvl or (not is_plain and _distance(scale, unit) < 3.0 * _UNIT_TOLERANCE):
        factor = unit if is_unit else scale
        said = f": it is in {name}" if is_unit else ", which is no unit"
        result.tell(
            "dvl_unit",
            "velocity",
            f"its velocity is {1.0 / scale:.3g} times that of the sonar's echoes{said} "
            f"(conventions.velocity_scale: {factor:.4g})",
            velocity_scale=float(f"{factor:.4g}"),
        )
        return
    factor = plain if is_plain else scale
    result.tell(
        "sonar_range_factor",
        "sonar",
        f"its echoes move {scale:.3g} times as far as the dvl says, which is no unit that a dvl "
        "has: the range, the length of its bins or the unit is set wrong "
        f"(conventions.sonar_range_scale: {1.0 / factor:.4g}); or it is the dvl's scale after "
        f"all (conventions.velocity_scale: {scale:.4g} instead)",
        sonar_range_scale=float(f"{1.0 / factor:.4g}"),
    )


def _distance(scale: float, factor: float) -> float:
    return abs(math.log(scale / factor))


def confidence_in(value: float, sigma: float) -> float:
    """How sure a value is not zero, 0.5 to 1."""
    return 0.5 + 0.5 * math.erf(abs(value) / max(sigma, 1e-9) / math.sqrt(2.0))
