"""Sessions: what a map queue knows, kept on disk so that it outlives the process.

A session is a folder with an SQLite file. Saving writes what is new in one transaction: a process
that is killed at any point leaves the session as it was before or as it is after. Beside it lie
the state of the last start, for when the file is damaged, and the lock of who is writing.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.io.sessions.folder_lock import FolderLock, SessionInUseError
from uw_dslam_ros2.io.sessions.session_file import (
    FIRST_VERSION,
    VERSIONS,
    opened,
    read_records,
    write_records,
)
from uw_dslam_ros2.io.sessions.session_records import StateRecords, first_version_state, state_of

__all__ = [
    "GOOD_FILE",
    "SESSION_FILE",
    "SESSION_FOLDER",
    "Session",
    "SessionInUseError",
    "has_session",
    "load_session",
    "save_session",
    "session_of",
]

SESSION_FILE = "session.sqlite"
GOOD_FILE = "session.good.sqlite"
"""Copy of the session as it was read, whole, at the last start."""
SESSION_FOLDER = "session"
"""Where a result folder of ``offline`` or ``demo`` keeps its session."""
_EXTRA_BYTES = 1 << 26
"""Beyond the cells of its grid, what a submap may hold: points and path."""


class Session:
    """A session's folder, which one process at a time may write.

    Parameters
    ----------
    folder
        Made by the first save where it is missing.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._lock = FolderLock(self._folder, "manager")
        self._records = StateRecords()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def load(self, config: MapQueueConfig | None = None) -> MapQueue | None:
        """Go on from what is saved; None where nothing is. Keeps a copy of it.

        Raises
        ------
        SessionInUseError
            If another process has the folder.
        DataError
            Naming the file, the records that are damaged, and where the copy of the last start is.
        """
        try:
            self._lock.acquire()
        except SessionInUseError:
            raise
        except DataError as error:
            logging.getLogger(__name__).warning("%s", error)  # readable all the same
        if not has_session(self._folder):
            return None
        queue = load_session(self._folder, config)
        if self._lock.is_held:
            self._keep_copy()
        return queue

    def save(self, queue: MapQueue) -> Path:
        """Make the session equal to the queue; costs what has changed since the last time.

        Returns
        -------
        Path
            The session's file.

        Raises
        ------
        SessionInUseError
            If another process has the folder.
        DataError
            Naming the file and the reason; the session is then as it was.
        """
        self._lock.acquire()
        path = self._folder / SESSION_FILE
        try:
            write_records(path, self._records.of(queue.to_state()))
        except (sqlite3.Error, OSError) as error:
            raise DataError(f"cannot save the session {path}: {error}") from error
        return path

    def close(self) -> None:
        """Let others have the folder."""
        self._lock.release()

    def _keep_copy(self) -> None:
        copy = self._folder / GOOD_FILE
        new = copy.with_suffix(".tmp")
        try:
            shutil.copyfile(self._folder / SESSION_FILE, new)
            new.replace(copy)
        except OSError as error:
            new.unlink(missing_ok=True)
            logging.getLogger(__name__).warning("cannot copy the session to %s: %s", copy, error)


def save_session(folder: str | Path, queue: MapQueue) -> Path:
    """Save once, see `Session.save`."""
    with Session(folder) as session:
        return session.save(queue)


def session_of(folder: Path) -> Path:
    """Where the session of a result's folder is; the folder itself where it is one."""
    inner = folder / SESSION_FOLDER
    return inner if inner.is_dir() else folder


def has_session(folder: str | Path) -> bool:
    """Whether something is saved in a folder, be it whole or not."""
    path = Path(folder) / SESSION_FILE
    if not path.is_file():
        return False
    try:
        with opened(path) as (_, version):
            return version != 0
    except sqlite3.Error:
        return True


def load_session(folder: str | Path, config: MapQueueConfig | None = None) -> MapQueue:
    """Read a saved session; nothing is written.

    Raises
    ------
    DataError
        Naming the file and what is wrong with it.
    """
    path = Path(folder) / SESSION_FILE
    if not has_session(folder):
        raise DataError(f"there is no session: {path} does not exist, or holds nothing yet")
    max_bytes = (config or MapQueueConfig()).max_submap_cells + _EXTRA_BYTES
    try:
        with opened(path) as (connection, version):
            if version == FIRST_VERSION:
                state = first_version_state(connection, max_bytes)
            elif version in VERSIONS:
                state = state_of(read_records(connection), max_bytes)
            else:
                raise DataError(f"it is of format {version}, expected up to {max(VERSIONS)}")
        return MapQueue.from_state(state, config)
    except (sqlite3.Error, OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        good = path.with_name(GOOD_FILE)
        remedy = f"; {good} is as it was at the last start: it may be put in its place"
        raise DataError(
            f"{path} is not a whole session: {error}{remedy if good.is_file() else ''}"
        ) from error
