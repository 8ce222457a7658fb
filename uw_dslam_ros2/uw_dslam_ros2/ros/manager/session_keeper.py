"""The manager's session: saved after every change, and a disk that fails stops nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.io.sessions.session import Session, save_session

__all__ = ["SessionKeeper"]

_RETRY_PERIOD_S = 2.0


class SessionKeeper:
    """Saves a queue; what a full or read-only disk refuses is reported, and tried again.

    Parameters
    ----------
    folder
        Of the session; empty: nothing is kept.
    complain
        Told whenever saving fails.
    """

    def __init__(self, folder: str, complain: Callable[[str], None]) -> None:
        self._folder = Path(folder) if folder else None
        self._session = Session(folder) if folder else None
        self._complain = complain
        self._is_saved = True
        self._tried_s = float("-inf")
        self.trouble = ""
        """Why what is known now is not on the disk; empty: it is, or will be at once."""

    def load(self, config: MapQueueConfig) -> MapQueue | None:
        """What is saved; None where nothing is. Raises `DataError`, see `Session.load`."""
        return self._session.load(config) if self._session else None

    def note_change(self) -> None:
        """The queue is not any more as it was saved."""
        self._is_saved = False

    def save_if_due(self, queue: MapQueue) -> None:
        """Save what has changed, unless that failed a moment ago."""
        now_s = time.monotonic()
        if self._is_saved or (self.trouble and now_s - self._tried_s < _RETRY_PERIOD_S):
            return
        self._tried_s = now_s
        self._try(queue)

    def save_in(self, folder: str, queue: MapQueue) -> Path:
        """Save in any folder; in the own one without asking oneself for the lock."""
        if self._session is None or self._folder is None or not _is_same(self._folder, folder):
            return save_session(folder, queue)
        return self._session.save(queue)

    def close(self, queue: MapQueue) -> None:
        """Save a last time, and let others have the folder."""
        if not self._is_saved:
            self._try(queue)
        if self._session is not None:
            self._session.close()

    def _try(self, queue: MapQueue) -> None:
        if self._session is None:
            self._is_saved = True
            return
        try:
            self._session.save(queue)
        except DataError as error:
            self.trouble = str(error)
            self._complain(self.trouble)
        else:
            self._is_saved = True
            self.trouble = ""


def _is_same(first: Path, second: str) -> bool:
    return first.resolve() == Path(second).resolve()
