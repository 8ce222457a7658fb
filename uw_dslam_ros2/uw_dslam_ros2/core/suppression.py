"""Non-maximum suppression: of things that lie near each other the best one is kept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["first_apart"]


def first_apart(
    count: int, is_near: Callable[[int], NDArray[np.bool_]], limit: int | None = None
) -> list[int]:
    """Indices, rising, of things sorted best first that are not near to a better one kept.

    Parameters
    ----------
    count
        How many things there are.
    is_near
        For an index, which things (count,) are near to that one.
    limit
        No more than so many are kept.
    """
    is_suppressed = np.zeros(count, dtype=np.bool_)
    kept: list[int] = []
    for index in range(count):
        if len(kept) == limit:
            break
        if not is_suppressed[index]:
            kept.append(index)
            is_suppressed |= is_near(index)
    return kept
