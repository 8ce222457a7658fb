"""Replace files whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError

__all__ = ["write_files"]


def write_files(contents: Mapping[Path, bytes | Iterable[bytes]]) -> list[Path]:
    """Write files whole: all beside their places first, then each is renamed, in the order given.

    A content may come in parts, which are asked for one after the other.

    A crash leaves every file either as it was or complete. Put the file that names the others
    last: whoever reads it finds them in place.

    Raises
    ------
    DataError
        With the path and the system's reason; no existing file was touched unless the renaming
        itself failed.
    """
    temporary: dict[Path, Path] = {}
    try:
        for path, content in contents.items():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary[path] = _write_beside(path, content)
            except OSError as error:
                raise DataError(f"cannot write {path}: {error.strerror or error}") from error
        for path in contents:
            try:
                os.replace(temporary[path], path)
            except OSError as error:
                raise DataError(f"cannot replace {path}: {error.strerror or error}") from error
            del temporary[path]
    finally:
        for leftover in temporary.values():
            with contextlib.suppress(OSError):
                leftover.unlink()
    return list(contents)


def _write_beside(path: Path, content: bytes | Iterable[bytes]) -> Path:
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines([content] if isinstance(content, bytes) else content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp keeps files to their owner; maps are for sharing.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    return Path(name)
