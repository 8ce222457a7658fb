"""What the examinations of several vehicles say together: one water has one speed of sound."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor.examination import Examination, ScaleEstimate
from uw_dslam_ros2.core.findings import Finding

__all__ = ["share_sound_speed"]

_OWN_SIGMA = 0.007
"""Of a DVL's own scale: what is left of a ratio when the speed of sound is accounted for."""
_AGREE = 3.0  # standard deviations between a ratio and that of all
_LEAST = 0.0095
"""Half of what one vehicle alone must be off; the mean of several is known better."""
_SOUND_SPEED, _DVL_SCALE = "sound_speed", "dvl_scale"


def share_sound_speed(examined: Sequence[Examination]) -> list[Examination]:
    """Have vehicles that map the same water read their sonars with the same speed of sound.

    A ratio of the echoes' way to the DVL's holds the error of the sonar's speed of sound, which
    all have in common, and that of the DVL's own scale. So where one ratio is so far above 1 that
    a speed of sound was found to be wrong, all are read with the mean of those that agree with
    most others, also vehicles that were too near to 1, or showed too little. One that contradicts
    them has a DVL of a wrong scale.

    What is not about a speed of sound stays as it is; nothing changes for a single vehicle.
    """
    known = {i: own.scale for i, own in enumerate(examined) if own.scale is not None}
    suspects = [i for i in known if _told(examined[i])]
    result = list(examined)
    if len(known) < 2 or not suspects:
        return result
    agreeing = _largest_agreement(known)
    mean = _mean([known[i] for i in agreeing])
    is_water = mean - 1.0 >= _LEAST and any(i in agreeing for i in suspects)
    if is_water and len(agreeing) < 2:
        return result  # each contradicts the others, and none is right
    common = mean if is_water else 1.0
    for i, own in enumerate(examined):
        is_odd = i in known and (i not in agreeing or not is_water)
        if is_water and (_told(own) or own.conventions.sonar_range_scale == 1.0):
            result[i] = _with_sound_speed(own, common, len(agreeing), is_odd=is_odd)
        if is_odd and (is_water or i in suspects) and known[i].by == "velocity":
            result[i] = _with_dvl_scale(result[i], known[i], common)
    return result


def _told(examined: Examination) -> Finding | None:
    found = [finding for finding in examined.findings if finding.kind == _SOUND_SPEED]
    return found[0] if found else None


def _variance(scale: ScaleEstimate) -> float:
    return scale.sigma**2 + _OWN_SIGMA**2


def _mean(scales: Sequence[ScaleEstimate]) -> float:
    weights = [1.0 / _variance(scale) for scale in scales]
    return float(np.average([scale.ratio for scale in scales], weights=weights))


def _largest_agreement(known: Mapping[int, ScaleEstimate]) -> list[int]:
    """The most vehicles whose ratios agree with one of them; of as many, those nearer to 1."""
    sets = [
        [
            i
            for i, other in known.items()
            if abs(other.ratio - centre.ratio)
            <= _AGREE * math.sqrt(_variance(other) + _variance(centre))
        ]
        for centre in known.values()
    ]
    return max(sets, key=lambda own: (len(own), -abs(_mean([known[i] for i in own]) - 1.0)))


def _with_sound_speed(
    examined: Examination, common: float, num_agreeing: int, *, is_odd: bool
) -> Examination:
    per_cent = 100.0 * (common - 1.0)
    mend = f"conventions.sonar_range_scale: {1.0 / common:.3f}"
    told = _told(examined)
    if told and not is_odd and examined.scale is not None:
        detail = (
            f"its echoes move {100.0 * (examined.scale.ratio - 1.0):.1f} % farther than the dvl "
            f"says, and {per_cent:.1f} % by all {num_agreeing} vehicles that agree, as with a "
            f"speed of sound that is too high for colder or fresher water ({mend}); or the dvls' "
            "scales are too small (conventions.velocity_scale instead)"
        )
    else:
        detail = (
            f"its ranges are {per_cent:.1f} % too long, as those of other vehicles in the same "
            f"water, whose speed of sound is too high for it ({mend})"
        )
    finding = Finding(_SOUND_SPEED, "sonar", detail, 1.0, vehicle_id=examined.vehicle_id)
    others = [f for f in examined.findings if f is not told]
    return replace(
        examined,
        findings=[*others, finding],
        conventions=_changed(examined, sonar_range_scale=round(1.0 / common, 4)),
        mended=examined.mended | {_SOUND_SPEED},
    )


def _with_dvl_scale(examined: Examination, scale: ScaleEstimate, common: float) -> Examination:
    own = scale.ratio / common
    way, size = ("shorter", "small") if own > 1.0 else ("longer", "large")
    finding = Finding(
        _DVL_SCALE,
        "velocity",
        f"its way is {100.0 * abs(1.0 - 1.0 / own):.1f} % {way} than the sonar's echoes move, "
        f"by the speed of sound that other vehicles find in the same water: its scale is too "
        f"{size} (conventions.velocity_scale: {own:.3f})",
        vehicle_id=examined.vehicle_id,
    )
    is_water = common != 1.0
    replaced = {_DVL_SCALE} if is_water else {_DVL_SCALE, _SOUND_SPEED}
    others = [f for f in examined.findings if f.kind not in replaced]
    changes = {} if is_water else {"sonar_range_scale": 1.0}
    return replace(
        examined,
        findings=[*others, finding],
        conventions=_changed(examined, velocity_scale=round(own, 4), **changes),
        mended=(examined.mended if is_water else examined.mended - {_SOUND_SPEED}) | {_DVL_SCALE},
    )


def _changed(examined: Examination, **changes: float) -> Conventions:
    return Conventions(**(examined.conventions.to_dict() | changes))
