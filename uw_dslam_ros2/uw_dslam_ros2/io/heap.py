"""How the memory of a large step is given back before the next one.

glibc's `malloc` takes from the system what a step needs, but keeps it in the holes between what
is still held: the peak of a run was the sum of its steps', not the largest of them.
"""

from __future__ import annotations

import ctypes
import functools
import gc

__all__ = ["give_back", "keep_apart", "trim"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # as in malloc.h


def keep_apart() -> None:
    """Take each array of a megabyte and more from the system by itself; it goes back when freed.

    Other C libraries have other ways: there nothing is done.
    """
    libc = _libc()
    if libc is not None:
        # Setting one of them fixes the others, which would go on to grow.
        libc.mallopt(_MMAP_THRESHOLD, 1 << 20)
        libc.mallopt(_TRIM_THRESHOLD, 1 << 25)
        libc.mallopt(_ARENA_MAX, 2)


def give_back() -> None:
    """Return to the system what nobody uses any more, also between smaller things."""
    gc.collect()
    trim()


def trim() -> None:
    """Return to the system what is free already; takes milliseconds."""
    libc = _libc()
    if libc is not None:
        libc.malloc_trim(0)


@functools.cache
def _libc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
    except OSError:
        return None
    return libc if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim") else None
