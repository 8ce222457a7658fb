"""The file of a session: named records in SQLite, each with a checksum, changed all at once.

What is read is what was written, or an error says which record is not: a checksum covers each
record with its name, and the manifest, itself a record, covers the set of them.
"""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError

__all__ = [
    "FIRST_VERSION",
    "VERSION",
    "VERSIONS",
    "Record",
    "RecordName",
    "opened",
    "read_records",
    "write_records",
]

VERSION = 3
"""Written; whoever knows older ones only refuses it, rather than to lose what people decided."""
VERSIONS = 2, VERSION
"""Read, in the table below."""
FIRST_VERSION = 1
"""Format of old files, without checksums, in four tables."""
_OLD_TABLES = ("meta", "submaps", "withdrawn", "answers")
_MANIFEST = ("manifest", "")
_TABLE = """
CREATE TABLE records (
    kind BLOB NOT NULL, key BLOB NOT NULL, digest BLOB NOT NULL, checksum BLOB NOT NULL,
    content BLOB NOT NULL, PRIMARY KEY (kind, key))
"""

RecordName = tuple[str, str]
"""Kind and key."""


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """What a record shall hold; it is encoded only where the file holds another digest."""

    digest: bytes
    encode: Callable[[], bytes]

    @classmethod
    def of(cls, content: bytes) -> Record:
        """Of what is encoded already."""
        return cls(_hash(content), lambda: content)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Connection to a file, and the format of what is saved in it; 0: nothing yet."""
    connection = sqlite3.connect(path, isolation_level=None)
    # Where the file is damaged, a text need not be one.
    connection.text_factory = bytes
    try:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version == FIRST_VERSION and not connection.execute("SELECT 1 FROM meta").fetchone():
            version = 0  # the first save was interrupted after making the tables
        yield connection, version
    finally:
        connection.close()


def read_records(connection: sqlite3.Connection) -> dict[RecordName, bytes]:
    """All records of a file of one of the formats `VERSIONS`.

    Raises
    ------
    DataError
        Naming the records that are damaged or missing.
    """
    found: dict[RecordName, bytes] = {}
    checksums: dict[RecordName, bytes] = {}
    damaged: list[str] = []
    rows = connection.execute("SELECT kind, key, digest, checksum, content FROM records")
    for kind, key, digest, checksum, content in rows:
        if not all(isinstance(part, bytes) for part in (kind, key, digest, checksum, content)):
            damaged.append("a record without a name")
            continue
        name = kind.decode(errors="replace"), key.decode(errors="replace")
        if _checksum(name, digest, content) != checksum:
            damaged.append(" ".join(name).strip())
            continue
        found[name], checksums[name] = content, checksum
    manifest = found.pop(_MANIFEST, None)
    checksums.pop(_MANIFEST, None)
    if damaged:
        raise DataError(f"damaged: {', '.join(sorted(damaged))}")
    if manifest != _manifest(checksums):
        raise DataError(f"records are missing: {len(found)} are left, and they are not all")
    return found


def write_records(path: Path, records: Mapping[RecordName, Record]) -> None:
    """Make the records of a file these, in one transaction; what is the same stays untouched.

    Raises
    ------
    DataError
        If the file is of a format that is not known.
    sqlite3.Error
        With the file as it was.
    """
    with opened(path) as (connection, version):
        if version not in (0, FIRST_VERSION, *VERSIONS):
            raise DataError(f"{path} is a session of format {version}, expected up to {VERSION}")
        connection.execute("BEGIN IMMEDIATE")
        try:
            if version not in VERSIONS:
                for table in _OLD_TABLES:
                    connection.execute(f"DROP TABLE IF EXISTS {table}")
                connection.execute(_TABLE)
            if version != VERSION:
                connection.execute(f"PRAGMA user_version = {VERSION}")
            _replace(connection, records)
            connection.execute("COMMIT")
        except BaseException:
            connection.rollback()
            raise


def _replace(connection: sqlite3.Connection, records: Mapping[RecordName, Record]) -> None:
    held = {
        (kind.decode(), key.decode()): (digest, checksum)
        for kind, key, digest, checksum in connection.execute(
            "SELECT kind, key, digest, checksum FROM records"
        )
    }
    for kind, key in sorted(set(held) - set(records) - {_MANIFEST}):
        where = "WHERE kind = ? AND key = ?"
        connection.execute(f"DELETE FROM records {where}", (kind.encode(), key.encode()))
    checksums = {}
    for name in sorted(records):
        record = records[name]
        if name in held and held[name][0] == record.digest:
            checksums[name] = held[name][1]
        else:
            checksums[name] = _put(connection, name, record)
    manifest = Record.of(_manifest(checksums))
    if held.get(_MANIFEST, (b"",))[0] != manifest.digest:
        _put(connection, _MANIFEST, manifest)


def _put(connection: sqlite3.Connection, name: RecordName, record: Record) -> bytes:
    content = record.encode()
    checksum = _checksum(name, record.digest, content)
    row = (name[0].encode(), name[1].encode(), record.digest, checksum, content)
    connection.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?, ?)", row)
    return checksum


def _manifest(checksums: Mapping[RecordName, bytes]) -> bytes:
    return _hash(*(checksums[name] for name in sorted(checksums)))


def _checksum(name: RecordName, digest: bytes, content: bytes) -> bytes:
    return _hash(name[0].encode(), name[1].encode(), digest, content)


def _hash(*parts: bytes) -> bytes:
    hasher = hashlib.blake2b(digest_size=16)
    for part in parts:
        hasher.update(len(part).to_bytes(8, "little"))
        hasher.update(part)
    return hasher.digest()
