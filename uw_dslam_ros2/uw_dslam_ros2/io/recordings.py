"""Bags as files: rosbag2 and ROS 1 recordings, message by message."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import (
    Connection,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer,
    WriterError,
)
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.io.storages import BROKEN, Ros1Storage, Storage, open_storages, uncompressed

__all__ = ["BagReader", "BagWriter", "Message", "RawMessage", "open_bag", "open_bags"]

_STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_IDL_SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as it lies in the bag: ``data`` is CDR, ``stamp_ns`` the time of recording."""

    topic: str
    msgtype: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One deserialised message; ``content`` has the fields of its type, arrays are read-only."""

    topic: str
    msgtype: str
    stamp_ns: int
    content: Any


class BagReader:
    """An open recording; made by `open_bag`.

    ``damage`` says what is missing of it, "" where it is whole.
    """

    def __init__(self, path: Path, storages: Sequence[Storage], damage: str = "") -> None:
        self.path = path
        self.damage = damage
        self._storages = storages
        self._typestores: dict[str, Typestore] = {}
        self.topics: dict[str, str] = {}
        self.message_counts: dict[str, int] = {}
        for connection in self._connections():
            known = self.topics.setdefault(connection.topic, connection.msgtype)
            if known != connection.msgtype:
                raise DataError(
                    f"{path}: topic {connection.topic} has two types, "
                    f"{known} and {connection.msgtype}"
                )
            count = self.message_counts.get(connection.topic, 0)
            self.message_counts[connection.topic] = count + connection.msgcount
        filled = [storage for storage in storages if storage.message_count]
        self.start_ns = min(storage.start_time for storage in filled)
        self.end_ns = max(storage.end_time for storage in filled) - 1

    def _connections(self) -> Iterator[Connection]:
        for storage in self._storages:
            yield from storage.connections

    def raw(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Messages in order of recording; `topics` None means all, `stop_ns` is exclusive.

        Raises
        ------
        DataError
            If a topic is not in the bag, or the file turns out to be damaged on the way.
        """
        for topic in topics or ():
            if topic not in self.topics:
                raise DataError(
                    f"{self.path}: no topic {topic}; there are {', '.join(sorted(self.topics))}"
                )
        streams = []
        for storage in self._storages:
            wanted = [c for c in storage.connections if topics is None or c.topic in topics]
            if wanted:
                streams.append(storage.messages(wanted, start_ns, stop_ns))
        ordered = streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda m: m[1])
        with _explained(self.path):
            for connection, stamp_ns, data in ordered:
                yield RawMessage(
                    connection.topic, connection.msgtype, stamp_ns, uncompressed(data)
                )

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Message]:
        """The same as `raw`, deserialised."""
        for raw in self.raw(topics, start_ns, stop_ns):
            yield Message(raw.topic, raw.msgtype, raw.stamp_ns, self.deserialize(raw))

    def deserialize(self, raw: RawMessage) -> Any:
        """Content of a message of this bag, after the definitions that the bag itself carries."""
        try:
            return self._store(raw.msgtype).deserialize_cdr(raw.data, raw.msgtype)
        except (SerdeError, TypesysError, KeyError, *BROKEN) as error:
            raise DataError(
                f"{self.path}: a message on {raw.topic} at {raw.stamp_ns} ns does not fit "
                f"its type {raw.msgtype}: {error or type(error).__name__}"
            ) from error

    def has_header(self, msgtype: str) -> bool:
        """Whether a type begins with a ``std_msgs/Header``, and so with a stamp."""
        fields = self._store(msgtype).fielddefs[msgtype][1]
        return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"

    def _store(self, msgtype: str) -> Typestore:
        if msgtype not in self._typestores:
            self._typestores[msgtype] = self._typestore_of(msgtype)
        return self._typestores[msgtype]

    def _typestore_of(self, msgtype: str) -> Typestore:
        """Types that one topic's messages need; those of other topics may be unknown."""
        for storage in self._storages:
            for connection in storage.connections:
                if connection.msgtype == msgtype:
                    if isinstance(storage, Ros1Storage):
                        return storage.store_of(connection)
                    return _typestore_of(self.path, connection)
        raise DataError(f"{self.path}: no topic has type {msgtype}")


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except DataError:
        raise
    except BROKEN as error:
        raise DataError(
            f"{path} is damaged, truncated, or was not closed by its recorder "
            f"({error or type(error).__name__}); expected a complete recording"
        ) from error


@contextmanager
def open_bag(path: str | Path) -> Iterator[BagReader]:
    """Open a recording: a rosbag2 folder, an ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.

    Split and compressed recordings, those without metadata.yaml and those that were cut off are
    read as far as they can be; `BagReader.damage` tells of it.

    Raises
    ------
    DataError
        If the file is missing, of another format, unreadable, or holds no messages.
    """
    path = Path(path)
    with ExitStack() as stack:
        storages, damage = open_storages(path, stack)
        if not sum(storage.message_count for storage in storages):
            raise DataError(f"{path} is empty; expected a recording with at least one message")
        yield BagReader(path, storages, damage)


@contextmanager
def open_bags(paths: Sequence[str | Path]) -> Iterator[list[BagReader]]:
    """Open several recordings; `merged` reads them as one."""
    if not paths:
        raise DataError("no bags given; expected at least one path")
    with ExitStack() as stack:
        yield [stack.enter_context(open_bag(path)) for path in paths]


def _typestore_of(path: Path, connection: Connection) -> Typestore:
    """Types as the bag defines them; one without a definition as we know it."""
    store = get_typestore(Stores.EMPTY)
    definition = connection.msgdef
    try:
        if definition.format == MessageDefinitionFormat.MSG:
            types = get_types_from_msg(definition.data, connection.msgtype)
        elif definition.format == MessageDefinitionFormat.IDL:
            types = {}
            for part in definition.data.split(_IDL_SEPARATOR):
                if part:
                    text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
                    types.update(get_types_from_idl(text))
        else:
            types = dict(make_typestore().fielddefs)
            if connection.msgtype not in types:
                raise DataError(
                    f"{path}: topic {connection.topic} has type {connection.msgtype}, which "
                    "the bag does not define and we do not know"
                )
        store.register({name: t for name, t in types.items() if name not in store.fielddefs})
    except TypesysError as error:
        raise DataError(f"{path}: bad definition of {connection.msgtype}: {error}") from error
    return store


def merged(
    readers: Sequence[BagReader], topics: Sequence[Collection[str]]
) -> Iterator[tuple[int, RawMessage]]:
    """Raw messages of several bags in order of recording, each with its bag's index.

    `topics` says for each bag which ones. Messages of the same time come in the order of the bags.
    """

    def numbered(index: int) -> Iterator[tuple[int, int, RawMessage]]:
        for raw in readers[index].raw(topics[index]):
            yield raw.stamp_ns, index, raw

    streams = [numbered(i) for i in range(len(readers)) if topics[i]]
    for _, index, raw in heapq.merge(*streams, key=lambda item: item[:2]):
        yield index, raw


_ZERO = QosTime(0, 0)
_FOREVER = QosTime(9223372036, 854775807)


def _qos(is_latched: bool) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        1 if is_latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if is_latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


class BagWriter:
    """Writes a rosbag2 folder; a context manager, complete when left without an error.

    Parameters
    ----------
    path : path of the folder, which must not exist yet.
    storage : "mcap" (its chunks compressed) or "sqlite3" (uncompressed).
    """

    def __init__(self, path: str | Path, storage: str = "mcap") -> None:
        if storage not in _STORAGES:
            raise DataError(f"storage is {storage!r}, expected one of {', '.join(_STORAGES)}")
        self.path = Path(path)
        self.typestore = make_typestore()
        self._connections: dict[str, Connection] = {}
        try:
            self._writer = Writer(self.path, version=9, storage_plugin=_STORAGES[storage])
        except WriterError as error:
            raise DataError(f"cannot write {self.path}: {error}") from error
        if storage == "mcap":
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def __enter__(self) -> Self:
        try:
            self._writer.open()
        except (WriterError, OSError) as error:
            raise DataError(f"cannot write {self.path}: {error}") from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def add_topic(self, topic: str, msgtype: str, *, is_latched: bool = False) -> None:
        """Announce a topic; `is_latched` records it as transient local with depth 1."""
        if topic in self._connections:
            raise DataError(f"{self.path}: topic {topic} was announced before")
        self._connections[topic] = self._writer.add_connection(
            topic, msgtype, typestore=self.typestore, offered_qos_profiles=[_qos(is_latched)]
        )

    def write(self, topic: str, stamp_ns: int, content: Any) -> None:
        """Serialise and append one message (an instance of a class of ``typestore.types``)."""
        connection = self._connections[topic]
        self._writer.write(
            connection, stamp_ns, self.typestore.serialize_cdr(content, connection.msgtype)
        )

    def write_raw(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Append one serialised message."""
        self._writer.write(self._connections[topic], stamp_ns, data)
