"""One process at a time writes to a folder."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
from pathlib import Path
from typing import IO

from uw_dslam_ros2.core.errors import DataError

__all__ = ["FolderLock", "SessionInUseError"]

_FILE = "session.lock"


class SessionInUseError(DataError):
    """Another process is writing the session."""


class FolderLock:
    """Held until it is released, or the process ends in any way.

    Parameters
    ----------
    folder
        Made where it is missing.
    owner
        What writes to such folders, for the message: "manager".
    """

    def __init__(self, folder: Path, owner: str) -> None:
        self._folder, self._owner = folder, owner
        self._file: IO[str] | None = None

    @property
    def is_held(self) -> bool:
        """Whether this process has the folder."""
        return self._file is not None

    def acquire(self) -> None:
        """Have the folder; again also where its disk was exchanged meanwhile.

        Raises
        ------
        SessionInUseError
            If another process has it.
        DataError
            If nothing can be written there.
        """
        path = self._folder / _FILE
        if self._file is not None and _is_same_file(self._file, path):
            return
        self.release()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            lock = path.open("a+")
        except OSError as error:
            raise DataError(f"cannot write to the session {self._folder}: {error}") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            holder = lock.read(200).strip() or "another process"
            lock.close()
            raise SessionInUseError(
                f"the session {self._folder} is written by {holder}; give each {self._owner} a "
                "folder of its own"
            ) from None
        self._file = lock
        with contextlib.suppress(OSError):  # on a full disk: it names us to others, no more
            lock.truncate(0)
            lock.write(f"process {os.getpid()} on {socket.gethostname()}")
            lock.flush()

    def release(self) -> None:
        """Let others have the folder."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _is_same_file(file: IO[str], path: Path) -> bool:
    """Whether an open file is still what the path names: its disk may have been exchanged."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
