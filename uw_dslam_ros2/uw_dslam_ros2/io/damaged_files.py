"""Files of recordings that were not closed: what is readable of them is read."""

from __future__ import annotations

import heapq
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Collection, Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import apsw
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.storage_mcap import McapReader

__all__ = [
    "Chunk",
    "DamagedDatabase",
    "DamagedMcap",
    "check_database_size",
    "filled_up",
    "has_log",
    "with_log",
]

_REORDER = 200
"""Messages of a file without an index that are brought in order at a time."""

Chunk = tuple[Connection, int, bytes]
"""Topic, time of recording [ns], and CDR of a message."""


# --- sqlite3
# -----------------------------------------------------------------------------------------------


def check_database_size(file: Path) -> None:
    """Sqlite itself notices missing pages only when a query happens to need them."""
    with file.open("rb") as stream:
        header = stream.read(100)
    if len(header) < 100:
        raise ReaderError(f"{file.name} has no database header")
    page_size, num_pages = struct.unpack(">16xH10xI", header[:32])
    # A page size of 1 stands for 65536.
    expected = (65536 if page_size == 1 else page_size) * num_pages
    if (size := file.stat().st_size) < expected:
        raise ReaderError(f"{file.name} has {size} of {expected} bytes")


def filled_up(file: Path, stack: ExitStack) -> Path:
    """A copy of the length that its header tells of: else sqlite refuses all of it."""
    copy = Path(stack.enter_context(tempfile.TemporaryDirectory())) / file.name
    shutil.copy2(file, copy)
    with copy.open("r+b") as stream:
        page_size, num_pages = struct.unpack(">16xH10xI", stream.read(32))
        stream.truncate(
            max(file.stat().st_size, (page_size if page_size > 1 else 65536) * num_pages)
        )
    return copy


def _log_of(file: Path) -> Path:
    return file.with_name(f"{file.name}-wal")


def has_log(file: Path) -> bool:
    """Whether a write-ahead log lies beside a database."""
    return _log_of(file).is_file() and _log_of(file).stat().st_size > 0


def with_log(file: Path, stack: ExitStack) -> Path:
    """A copy that holds what still lies in the log: the user's own files are only read."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    for source in (file, _log_of(file)):
        shutil.copy2(source, folder / source.name)
    copy = folder / file.name
    with sqlite3.connect(copy) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("PRAGMA journal_mode=DELETE")
    connection.close()
    return copy


class DamagedDatabase:
    """As many messages of a database as can be read from its beginning; perhaps none."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._database = apsw.Connection(
            f"file:{path}?immutable=1", flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        )
        stack.callback(self._database.close)
        columns = [row[1] for row in self._database.execute("PRAGMA table_info(topics)")]
        if not columns:
            raise ReaderError(f"{path.name} has no topics")
        definitions = self._definitions()
        counts: dict[int, int] = {}
        stamps: list[int] = []
        for topic_id, stamp_ns in self._readable("topic_id, timestamp"):
            counts[topic_id] = counts.get(topic_id, 0) + 1
            stamps.append(stamp_ns)
        self.connections = [
            Connection(
                topic_id, topic, msgtype, definitions.get(msgtype, _NO_DEFINITION), "",
                counts.get(topic_id, 0), cast(Any, None), cast(Any, self),
            )
            for topic_id, topic, msgtype in cast(
                "list[tuple[int, str, str]]",
                self._database.execute("SELECT id, name, type FROM topics ORDER BY id").fetchall(),
            )
        ]  # fmt: skip
        self.message_count = len(stamps)
        self.start_time = min(stamps, default=0)
        self.end_time = max(stamps, default=0) + 1

    def _definitions(self) -> dict[str, MessageDefinition]:
        formats = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        try:
            rows = cast("list[tuple[str, str, str]]", self._database.execute(query).fetchall())
        except apsw.Error:  # earlier versions have none
            return {}
        return {name: MessageDefinition(formats[code], text) for name, code, text in rows}

    def _readable(self, columns: str) -> Iterator[tuple[Any, ...]]:
        try:
            # Of a row that was cut in two, nothing is known.
            yield from self._database.execute(
                f"SELECT {columns} FROM messages NOT INDEXED "
                "WHERE topic_id IS NOT NULL AND timestamp > 0 ORDER BY id"
            )
        except apsw.Error:
            return

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Chunk]:
        """As `Storage` says."""
        wanted = {connection.id: connection for connection in connections}
        for topic_id, stamp_ns, data in self._readable("topic_id, timestamp, data"):
            is_late = stop is not None and stamp_ns >= stop
            if topic_id in wanted and stamp_ns >= (start or 0) and not is_late:
                yield wanted[topic_id], stamp_ns, data


_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")


# --- MCAP
# -----------------------------------------------------------------------------------------------


class DamagedMcap(McapReader):
    """All complete records of a file without its end."""

    message_count = start_time = end_time = 0

    def _open(self) -> None:
        assert self.bio is not None
        if self.bio.read(8) != b"\x89MCAP0\r\n":
            raise ReaderError("it does not begin as an MCAP file does")
        self.data_start = 8
        self.data_end = self._end_of_records(self.path.stat().st_size)
        self.meta_scan()
        assert self.statistics is not None
        counts = self.statistics.channel_message_counts
        self.connections = [c._replace(msgcount=counts.get(c.id, 0)) for c in self.connections]
        self.message_count = self.statistics.message_count
        self.start_time, self.end_time = self.statistics.start_time, self.statistics.end_time + 1

    def _end_of_records(self, size: int) -> int:
        """Where the last complete record of data ends; a summary is not needed."""
        assert self.bio is not None
        position = self.data_start
        data_end_code, footer_code = 0x0F, 0x02
        while position + 9 <= size:
            self.bio.seek(position)
            code, length = struct.unpack("<BQ", self.bio.read(9))
            if code in (data_end_code, footer_code) or code == 0:
                break
            if position + 9 + length > size:
                break
            position += 9 + length
        return position

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[Chunk, None, None]:
        """As `Storage` says; recorders write nearly in order."""
        waiting: list[tuple[int, int, Connection, bytes]] = []
        scan = self.messages_scan(connections, start, stop)
        for number, (connection, stamp_ns, data) in enumerate(scan):
            heapq.heappush(waiting, (stamp_ns, number, connection, data))
            if len(waiting) > _REORDER:
                first = heapq.heappop(waiting)
                yield first[2], first[0], first[3]
        while waiting:
            first = heapq.heappop(waiting)
            yield first[2], first[0], first[3]
