"""Stamps that a driver fills in wrongly: not at all, with whole seconds, or in another unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding

__all__ = ["finding_of_unit", "in_unit", "unit_of_fractions", "why_useless"]

IntArray = NDArray[np.int64]

_SECOND_NS = 1_000_000_000
_MIN_STAMPS = 20
_PER_SECOND = 1.5  # messages, from where on whole seconds are no measurement's time


def why_useless(stamp_ns: IntArray) -> tuple[str, str]:
    """Kind and words of what keeps stamps (N,) from telling any time; empty where nothing does.

    Stamps of zero among others are bad messages, and say nothing of the clock.
    """
    if float(np.mean(stamp_ns <= 0)) > 0.5:
        return "zero_stamps", "are zero"
    known = stamp_ns[stamp_ns > 0]
    if len(known) < _MIN_STAMPS:
        return "", ""
    if not np.ptp(known):
        return "same_stamps", "are all the same"
    if not (known % _SECOND_NS).any() and _per_second(known) > _PER_SECOND:
        return "whole_seconds", "are whole seconds"
    return "", ""


def unit_of_fractions(stamp_ns: IntArray) -> int:
    """Nanoseconds that a step of ``nanosec`` stands for in stamps (N,): 1, of microseconds 1000.

    Of several messages a second some are stamped later than the first thousandth of it.
    """
    known = stamp_ns[stamp_ns > 0]
    if len(known) < _MIN_STAMPS or _per_second(known) <= _PER_SECOND:
        return 1
    largest = int((known % _SECOND_NS).max())
    if largest == 0 or largest >= _SECOND_NS // 1000:
        return 1
    return 1000 if largest >= 1000 else 1_000_000


def in_unit(stamp_ns: IntArray, unit_ns: int) -> IntArray:
    """Stamps (N,) whose fractions of a second are in units of so many nanoseconds."""
    seconds, fraction = np.divmod(stamp_ns, _SECOND_NS)
    return np.asarray(seconds * _SECOND_NS + fraction * unit_ns, np.int64)


def finding_of_unit(role: str, unit_ns: int) -> Finding:
    """What to tell of it."""
    unit = {1000: "microseconds", 1_000_000: "milliseconds"}[unit_ns]
    return Finding(
        "stamp_unit",
        role,
        f"the nanoseconds of its stamps never reach a thousandth of a second: they are {unit}, "
        "and are read so; mend the driver",
    )


def _per_second(stamp_ns: IntArray) -> float:
    return len(stamp_ns) / len(np.unique(stamp_ns // _SECOND_NS))
