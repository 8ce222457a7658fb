"""What has been worked out before, so that a plan that is made anew costs what is new in it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

__all__ = ["Memory"]

_MAX_ENTRIES = 50_000
_MAX_SOLUTIONS = 8


class Memory:
    """Results by all that they depend on; whatever is not asked for any more is forgotten."""

    def __init__(self) -> None:
        self._results = _Generations(_MAX_ENTRIES)
        self._solutions = _Generations(_MAX_SOLUTIONS)

    def remember[T](self, key: Hashable, work: Callable[[], T]) -> T:
        """The result under a key; worked out only if it is not held."""
        return self._results.get(key, work)

    def remember_solution[T](self, key: Hashable, work: Callable[[], T]) -> T:
        """The same for results as large as a pose graph, of which few are kept."""
        return self._solutions.get(key, work)


class _Generations:
    """A cache of bounded size: what was not used for a whole generation goes."""

    def __init__(self, max_entries: int) -> None:
        self._max_entries = max_entries
        self._young: dict[Hashable, Any] = {}
        self._old: dict[Hashable, Any] = {}

    def get[T](self, key: Hashable, work: Callable[[], T]) -> T:
        if key in self._young:
            return self._young[key]
        found = self._old.pop(key) if key in self._old else work()
        if len(self._young) >= self._max_entries:
            self._old, self._young = self._young, {}
        self._young[key] = found
        return found
