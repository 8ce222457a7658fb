"""Files of recordings, whole or damaged: each with its topics, and its messages as CDR.

rosbag2 (MCAP, sqlite3; split, compressed, with a write-ahead log beside it, without metadata.yaml)
and ROS 1 bags. Of a file that was cut off, what is readable is read.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, cast

import apsw
import yaml
from backports import zstd
from rosbags import rosbag1
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.damaged_files import (
    Chunk,
    DamagedDatabase,
    DamagedMcap,
    check_database_size,
    filled_up,
    has_log,
    with_log,
)

__all__ = ["BROKEN", "Ros1Storage", "Storage", "Storages", "open_storages", "uncompressed"]

# What reading a broken file was seen to raise, beside the library's own errors.
BROKEN = (
    ReaderError,
    rosbag1.ReaderError,
    SerdeError,
    sqlite3.Error,
    apsw.Error,
    zstd.ZstdError,
    struct.error,
    zlib.error,
    EOFError,
    ValueError,
    TypeError,
    IndexError,
    KeyError,
    MemoryError,
    AssertionError,
)

_SUFFIXES = (".mcap", ".db3", ".bag")
_COMPRESSED = (".zstd", ".zst")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_EXPECTED = "expected a rosbag2 folder, an .mcap or .db3 file, or a ROS 1 .bag"


class Storage(Protocol):
    """One file's messages, in order of recording."""

    @property
    def connections(self) -> list[Connection]:
        """Topics, with the number of their messages."""

    @property
    def message_count(self) -> int:
        """Of all topics."""

    @property
    def start_time(self) -> int:
        """Of the first message [ns]."""

    @property
    def end_time(self) -> int:
        """Just after the last message [ns]."""

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Chunk]:
        """Topic, time of recording, and CDR of each message."""


Storages = tuple[list[Storage], str]
"""Files of a recording, and what is missing of it ("" where nothing is)."""


def open_storages(path: Path, stack: ExitStack) -> Storages:
    """Open all files of a recording; `stack` closes them.

    Raises
    ------
    DataError
        If there is no recording, or nothing of it can be read.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist; {_EXPECTED}")
    expected, problem = None, ""
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            try:
                return [_open_folder(path, stack)], _unlisted(path)
            except (*BROKEN, OSError) as error:
                problem = str(error) or type(error).__name__
                expected = _expected_count(path)
        files = _files_of(path)
        if not files and not problem:
            raise DataError(f"{path} holds no recording; {_EXPECTED}")
    elif _suffix(path) in _SUFFIXES:
        files = [path]
    else:
        raise DataError(f"{path} is not a bag; {_EXPECTED}")
    storages: list[Storage] = []
    is_damaged = False
    for file in files:
        try:
            storage, is_whole = _open_file(file, stack)
        except (*BROKEN, OSError) as error:
            problem = problem or f"{file.name}: {error or type(error).__name__}"
            is_damaged = True
            continue
        is_damaged |= not is_whole
        storages.append(storage)
    count = sum(storage.message_count for storage in storages)
    if not count and (problem or is_damaged):
        raise DataError(
            f"{path} is damaged, truncated, or was not closed by its recorder ({problem}); "
            "nothing of it can be read"
        )
    return storages, _damage(count, expected, is_damaged=is_damaged)


def uncompressed(data: bytes) -> bytes:
    """A message as it was written, also where the recorder compressed each by itself."""
    return zstd.decompress(data) if data[:4] == _ZSTD_MAGIC else data


def _damage(count: int, expected: int | None, *, is_damaged: bool) -> str:
    if expected is not None and count < expected:
        share = 100.0 * (expected - count) / expected
        return (
            f"only {count} of the {expected} messages that its metadata tell of can be read; "
            f"{share:.0f} % are missing"
        )
    if is_damaged and expected is None:
        return (
            f"its end is missing, or it was not closed by its recorder; {count} messages are read"
        )
    return ""


def _suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix in _COMPRESSED else path.suffix


def _files_of(folder: Path) -> list[Path]:
    """Files of a split recording in the order of their numbers."""

    def key(path: Path) -> tuple[int, str]:
        number = path.name.split(".")[0].rsplit("_", 1)[-1]
        return (int(number) if number.isdigit() else 0, path.name)

    return sorted(
        (p for p in folder.iterdir() if _suffix(p) in _SUFFIXES and p.is_file()), key=key
    )


def _metadata(folder: Path) -> dict[str, Any]:
    """What the recorder wrote of a recording, as it stands there."""
    content = yaml.safe_load((folder / "metadata.yaml").read_text())
    return dict(content["rosbag2_bagfile_information"])


def _expected_count(folder: Path) -> int | None:
    try:
        return int(_metadata(folder)["message_count"])
    except (OSError, yaml.YAMLError, *BROKEN):
        return None


def _open_folder(path: Path, stack: ExitStack) -> Storage:
    for file in path.glob("*.db3"):
        if has_log(file):
            raise ReaderError(f"{file.name} has a write-ahead log")
        check_database_size(file)
    reader = stack.enter_context(Reader(path))
    if hidden := _hidden_topics(reader):
        raise ReaderError(f"metadata.yaml does not describe {', '.join(hidden)} as the file does")
    return cast(Storage, reader)


def _hidden_topics(reader: Reader) -> list[str]:
    """Topics that are in the files, but not as metadata.yaml has them.

    The library reads of a folder what its metadata tell of, topic, type and quality of service,
    and leaves out the rest without a word.
    """
    known = {(c.topic, c.msgtype, str(c.ext)) for c in reader.connections}
    in_files = {
        (c.topic, c.msgtype, str(c.ext))
        for storage in cast(Any, reader.storage).storages
        for c in storage.connections
        if c.msgcount
    }
    return sorted({topic for topic, _, _ in in_files - known})


def _unlisted(path: Path) -> str:
    """What to say of files that lie in the folder, but are not in its metadata."""
    names = {Path(name).name for name in _metadata(path)["relative_file_paths"]}
    others = [file.name for file in _files_of(path) if file.name not in names]
    if not others:
        return ""
    return (
        f"its metadata.yaml does not list {', '.join(others)}, and so it is not read; take the "
        "metadata away to have all files read, or a file that is none of it"
    )


def _open_file(path: Path, stack: ExitStack) -> tuple[Storage, bool]:
    """One file, and whether it is whole."""
    if path.suffix in _COMPRESSED:
        path, is_whole = _decompressed(path, stack)
        storage, is_inner_whole = _open_file(path, stack)
        return storage, is_whole and is_inner_whole
    if path.suffix == ".bag":
        return Ros1Storage(stack.enter_context(rosbag1.Reader(path))), True
    if path.suffix == ".db3":
        if has_log(path):
            path = with_log(path, stack)
        try:
            check_database_size(path)
            return cast(Storage, stack.enter_context(Reader(path))), True
        except BROKEN:
            return DamagedDatabase(filled_up(path, stack), stack), False
    try:
        return cast(Storage, stack.enter_context(Reader(path))), True
    except BROKEN:
        damaged = DamagedMcap(path)
        damaged.open()
        stack.callback(damaged.close)
        return cast(Storage, damaged), False


def _decompressed(path: Path, stack: ExitStack) -> tuple[Path, bool]:
    target = Path(stack.enter_context(tempfile.TemporaryDirectory()), path.stem)
    with zstd.open(path, "rb") as source, target.open("wb") as sink:
        try:
            shutil.copyfileobj(source, sink)
        except (EOFError, zstd.ZstdError):
            return target, False
    return target, True


# --- ROS 1
# -----------------------------------------------------------------------------------------------


class Ros1Storage:
    """A ROS 1 bag whose messages come out as those of ROS 2 do: CDR, headers without seq."""

    def __init__(self, reader: rosbag1.Reader) -> None:
        self._reader = reader
        self._stores: dict[str, Typestore] = {}
        self._own: dict[int, Connection] = {}
        self.connections = [self._as_ros2(connection) for connection in reader.connections]
        self.message_count = reader.message_count
        self.start_time, self.end_time = reader.start_time, reader.end_time

    def _as_ros2(self, connection: Connection) -> Connection:
        """The same topic, with a definition that fits the converted messages."""
        self._own[connection.id] = connection
        name = connection.msgtype.replace("tf/msg/tfMessage", "tf2_msgs/msg/TFMessage")
        return connection._replace(msgtype=name, owner=cast(Any, self))

    def store_of(self, connection: Connection) -> Typestore:
        """Types of one topic's messages."""
        if connection.msgtype not in self._stores:
            store = get_typestore(Stores.EMPTY)
            own = self._own[connection.id]
            types = dict(get_types_from_msg(own.msgdef.data, own.msgtype))
            if own.msgtype != connection.msgtype:
                types[connection.msgtype] = types.pop(own.msgtype)
            if header := types.get("std_msgs/msg/Header"):
                fields = [field for field in header[1] if field[0] != "seq"]
                types["std_msgs/msg/Header"] = (header[0], fields)
            ros2 = get_typestore(Stores.ROS2_JAZZY).fielddefs
            for needed in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
                types.setdefault(needed, ros2[needed])
            store.register({n: t for n, t in types.items() if n not in store.fielddefs})
            self._stores[connection.msgtype] = store
        return self._stores[connection.msgtype]

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Chunk]:
        """As `Storage` says."""
        wanted = {connection.id: connection for connection in connections}
        own = [self._own[key] for key in wanted]
        for connection, stamp_ns, data in self._reader.messages(own, start, stop):
            mine = wanted[connection.id]
            try:
                cdr = bytes(self.store_of(mine).ros1_to_cdr(data, mine.msgtype))
            except (SerdeError, TypesysError, *BROKEN):
                cdr = b""  # refused as a bad message when it is deserialised
            yield mine, stamp_ns, cdr
