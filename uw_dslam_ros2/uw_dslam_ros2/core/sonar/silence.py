"""Beams of an image that say nothing: dead receivers, and sectors that a driver masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["silent_beams"]

_MIN_STEPS = 16
"""Bins of a beam that hears noise which differ from its first, at least."""
_FEW = 0.05  # of the beams, that may have fewer by chance


def silent_beams(values: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which beams (B,) of pixels (R, B) hold one value only, where all others hold noise.

    A driver that sends nothing below a threshold leaves whole beams empty as well; there, some of
    the other beams have but few pixels, and no beam is said to be silent.
    """
    silent = np.asarray(values[0] == values[-1])
    silent[silent] = (values[:, silent] == values[0, silent]).all(axis=0)
    if silent.any() and not silent.all():
        heard = values[:, ~silent]
        steps = np.count_nonzero(heard != heard[0], axis=0)
        if np.quantile(steps, _FEW) >= _MIN_STEPS:
            return silent
    return np.zeros(values.shape[1], np.bool_)
