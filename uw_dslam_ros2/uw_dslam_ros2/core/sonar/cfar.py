"""Factors of constant-false-alarm-rate detectors for square-law (exponential) noise."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["cell_averaging_factor", "cell_averaging_factors", "smallest_of_factor"]


def cell_averaging_factor(num_cells: int, false_alarm_rate: float) -> float:
    """Factor on the mean of `num_cells` noise cells: ``alpha = N (P^(-1/N) - 1)``.

    Notes
    -----
    Finn and Johnson 1968; exact for independent exponential noise. No cells: infinite, nothing is
    ever detected.
    """
    if not 0.0 < false_alarm_rate < 1.0:
        raise InvalidInputError(
            f"false_alarm_rate is {false_alarm_rate}, expected a number between 0 and 1"
        )
    if num_cells < 0:
        raise InvalidInputError(f"num_cells is {num_cells}, expected 0 or more")
    if num_cells == 0:
        return math.inf
    return num_cells * math.expm1(-math.log(false_alarm_rate) / num_cells)


@lru_cache(maxsize=32)
def cell_averaging_factors(max_cells: int, false_alarm_rate: float) -> NDArray[np.float64]:
    """Factors (max_cells + 1,) for 0, 1, ... cells; read-only."""
    factors = np.array([cell_averaging_factor(n, false_alarm_rate) for n in range(max_cells + 1)])
    factors.flags.writeable = False
    return factors


def _smallest_of_rate(factor: float, num_side: int) -> float:
    """False alarm rate of smallest-of CFAR (Gandhi and Kassam 1988, eq.

    27) with `factor` on the mean of a side.
    """
    scale = factor / num_side  # on the sum
    log_base = math.log(2.0 + scale)
    terms = (
        math.exp(
            math.lgamma(num_side + k)
            - math.lgamma(k + 1)
            - math.lgamma(num_side)
            - (num_side + k) * log_base
        )
        for k in range(num_side)
    )
    return 2.0 * math.fsum(terms)


@lru_cache(maxsize=32)
def smallest_of_factor(num_side: int, false_alarm_rate: float) -> float:
    """Factor on the smaller of two means of `num_side` noise cells each."""
    if num_side < 1:
        raise InvalidInputError(f"num_side is {num_side}, expected at least 1")
    low, high = 0.0, 2.0 * cell_averaging_factor(num_side, false_alarm_rate) + 1.0
    while _smallest_of_rate(high, num_side) > false_alarm_rate:
        high *= 2.0
    from scipy.optimize import brentq  # large, and few detectors need it

    return float(
        brentq(lambda a: _smallest_of_rate(a, num_side) - false_alarm_rate, low, high, rtol=1e-12)
    )
