"""Compiled loops of the doctor."""

from __future__ import annotations

from numba import njit

__all__ = ["mean_nearness"]


@njit(cache=True, nogil=True)
def mean_nearness(stamp_s, stretch, x, y, min_apart_s, width_m, step):  # type: ignore[no-untyped-def]
    """Mean of ``1 / (1 + d^2 / width^2)^2`` over pairs of points, and how many pairs there are.

    Pairs are those of one stretch (N,) that were heard more than `min_apart_s` apart; times (N,)
    rise. Every `step`-th of the earlier points counts.
    """
    total, count = 0.0, 0
    scale = 1.0 / (width_m * width_m)
    first_later = 0
    num = x.shape[0]
    for i in range(0, num, step):
        while first_later < num and stamp_s[first_later] - stamp_s[i] <= min_apart_s:
            first_later += 1
        for j in range(first_later, num):
            if stretch[j] != stretch[i]:
                break  # stretches rise with time
            dx, dy = x[j] - x[i], y[j] - y[i]
            nearness = 1.0 / (1.0 + (dx * dx + dy * dy) * scale)
            total += nearness * nearness
            count += 1
    return (total / count if count else 0.0), count
