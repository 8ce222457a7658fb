"""Sessions: what a map queue knows, kept on disk so that it outlives the process.

A session is a folder with an SQLite file. Saving writes what is new in one transaction: a process
that is killed at any point leaves the session as it was before or as it is after. Beside it lie
the state of the last start, for when the file is damaged, and the lock of who is writing.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
import socket
import sqlite3
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import numpy as np

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import ConstraintKind, MapQueue, MapQueueConfig, QueueState
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track
from uw_dslam_ros2.io.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.maps import write_map
from uw_dslam_ros2.io.provenance import write_provenance
from uw_dslam_ros2.io.session_file import (
    FIRST_VERSION,
    VERSION,
    Record,
    opened,
    read_records,
    write_records,
)
from uw_dslam_ros2.io.trajectories import PoseGraphEdge, invertible, write_g2o, write_tum

__all__ = [
    "GOOD_FILE",
    "SESSION_FILE",
    "SESSION_FOLDER",
    "UNSURE_EDGE",
    "Session",
    "SessionInUseError",
    "export_queue",
    "has_session",
    "load_session",
    "save_session",
]

SESSION_FILE = "session.sqlite"
GOOD_FILE = "session.good.sqlite"
"""Copy of the session as it was read, whole, at the last start."""
SESSION_FOLDER = "session"
"""Where a result folder of ``offline`` or ``demo`` keeps its session."""
UNSURE_EDGE = "refused by itself; believed because others agree with it"
"""Comment on an edge of a pose graph."""
_LOCK_FILE = "session.lock"
_MAX_NAME = 80
_EXTRA_BYTES = 1 << 26
"""Beyond the cells of its grid, what a submap may hold: points and path."""


class SessionInUseError(DataError):
    """Another process is writing the session."""


class Session:
    """A session's folder, which one process at a time may write.

    Parameters
    ----------
    folder
        Made by the first save where it is missing.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._lock: IO[str] | None = None
        # Saving looks at all submaps; what did not change need not be hashed again.
        self._digests: dict[SubmapId, tuple[Submap, bytes]] = {}

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
            self._acquire()
        except SessionInUseError:
            raise
        except DataError as error:
            logging.getLogger(__name__).warning("%s", error)  # readable all the same
        if not has_session(self._folder):
            return None
        queue = load_session(self._folder, config)
        if self._lock is not None:
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
        self._acquire()
        path = self._folder / SESSION_FILE
        try:
            write_records(path, self._records(queue.to_state()))
        except (sqlite3.Error, OSError) as error:
            raise DataError(f"cannot save the session {path}: {error}") from error
        return path

    def close(self) -> None:
        """Let others have the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _acquire(self) -> None:
        path = self._folder / _LOCK_FILE
        if self._lock is not None and _is_same_file(self._lock, path):
            return
        self.close()
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
                f"the session {self._folder} is written by {holder}; give each manager a folder "
                "of its own"
            ) from None
        self._lock = lock
        with contextlib.suppress(OSError):  # on a full disk: it names us to others, no more
            lock.truncate(0)
            lock.write(f"process {os.getpid()} on {socket.gethostname()}")
            lock.flush()

    def _keep_copy(self) -> None:
        copy = self._folder / GOOD_FILE
        new = copy.with_suffix(".tmp")
        try:
            shutil.copyfile(self._folder / SESSION_FILE, new)
            new.replace(copy)
        except OSError as error:
            new.unlink(missing_ok=True)
            logging.getLogger(__name__).warning("cannot copy the session to %s: %s", copy, error)

    def _records(self, state: QueueState) -> dict[tuple[str, str], Record]:
        records: dict[tuple[str, str], Record] = {}
        digests: dict[SubmapId, tuple[Submap, bytes]] = {}
        for submap in state.submaps:
            held = self._digests.get(submap.submap_id)
            digest = held[1] if held and held[0] is submap else _submap_digest(submap)
            digests[submap.submap_id] = submap, digest
            records["submap", json.dumps(submap.submap_id)] = Record(
                digest, partial(_submap_to_bytes, submap)
            )
        self._digests = digests
        for submap_id in state.withdrawn:
            records["withdrawn", json.dumps(submap_id)] = Record.of(b"")
        for answer in state.answers:
            digest = _answer_digest(answer)
            records["answer", digest.hex()] = Record(digest, partial(_answer_to_bytes, answer))
        for name, value in _meta(state).items():
            records["meta", name] = Record.of(json.dumps(value).encode())
        return records


def save_session(folder: str | Path, queue: MapQueue) -> Path:
    """Save once, see `Session.save`."""
    with Session(folder) as session:
        return session.save(queue)


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
                state = _read_first_version(connection, max_bytes)
            elif version == VERSION:
                state = _state(read_records(connection), max_bytes)
            else:
                raise DataError(f"it is of format {version}, expected {VERSION}")
        return MapQueue.from_state(state, config)
    except (sqlite3.Error, OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        good = path.with_name(GOOD_FILE)
        remedy = f"; {good} is as it was at the last start: it may be put in its place"
        raise DataError(
            f"{path} is not a whole session: {error}{remedy if good.is_file() else ''}"
        ) from error


def export_queue(folder: str | Path, queue: MapQueue) -> list[Path]:
    """Write a queue for other programs; missing folders are made.

    ``map.{yaml,pgm,png}`` (global map), ``map_contradictions.png`` and ``map_provenance.npz`` (who
    saw what, see `write_provenance`), ``submaps/<vehicle>_<sequence>.*`` (each in its own frame;
    of a second run ``<vehicle>_run2_<sequence>.*``), ``trajectories/<vehicle>.tum`` (merged
    vehicles, in "map"), ``graph.g2o`` (the global component, without the edges found wrong).
    """
    folder = Path(folder)
    written: list[Path] = []
    occupancy = queue.global_map()
    if occupancy is not None:
        written += write_map(folder / "map", occupancy)
    provenance = queue.provenance()
    if provenance is not None:
        written += write_provenance(folder / "map", provenance)
    records = queue.submaps()
    names = RunNames(record.submap for record in records)
    for record in records:
        submap = record.submap
        run = names.file(submap.submap_id.track, _file_name(submap.vehicle_id))
        name = f"{run}_{submap.sequence:04d}"
        written += write_map(folder / "submaps" / name, submap.grid)
    for vehicle, (stamps_ns, poses) in queue.trajectories().items():
        path = folder / "trajectories" / f"{_file_name(vehicle)}.tum"
        path.parent.mkdir(parents=True, exist_ok=True)
        written.append(write_tum(path, stamps_ns, poses))
    joined = [record for record in records if record.component == 0]
    keys = {record.submap.submap_id: index for index, record in enumerate(joined)}
    vertices = {keys[r.submap.submap_id]: r.T_component_submap for r in joined}
    edges = [
        PoseGraphEdge(
            keys[c.target],
            keys[c.source],
            c.T_target_source,
            invertible(c.covariance) if c.kind is ConstraintKind.ODOMETRY else c.covariance,
            UNSURE_EDGE if c.is_unsure else "",
        )
        for c in queue.constraints()
        if c.is_inlier and c.source in keys and c.target in keys
    ]
    return [*written, write_g2o(folder / "graph.g2o", vertices, edges)]


def _file_name(vehicle_id: str) -> str:
    """Name for a vehicle's files: different for different vehicles, short, and in its folder."""
    # Percent signs come from quoting alone, hence mark what stands for more than itself.
    name = quote(vehicle_id, safe="")
    if name.startswith("."):
        name = f"%2E{name[1:]}"
    if len(name) > _MAX_NAME:
        name = (
            f"{name[:_MAX_NAME]}%{hashlib.blake2b(vehicle_id.encode(), digest_size=8).hexdigest()}"
        )
    return name or "%"


def _is_same_file(file: IO[str], path: Path) -> bool:
    """Whether an open file is still what the path names: its disk may have been exchanged."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


def _meta(state: QueueState) -> dict[str, Any]:
    return {
        "anchor": state.anchor,
        "lattice": None if state.lattice is None else _spec_to_plain(state.lattice),
        "vehicles": state.tracks,
        "next_request_id": state.next_request_id,
        "standing": [[s.hex(), t.hex(), prior] for s, t, prior in sorted(state.standing)],
        "is_pinned": state.is_pinned,
    }


def _state(records: dict[tuple[str, str], bytes], max_bytes: int) -> QueueState:
    of_kind: dict[str, dict[str, bytes]] = {}
    for (kind, key), content in sorted(records.items()):
        of_kind.setdefault(kind, {})[key] = content
    return _assembled(
        {name: json.loads(content) for name, content in of_kind.get("meta", {}).items()},
        list(of_kind.get("submap", {}).values()),
        [_submap_id(json.loads(key)) for key in of_kind.get("withdrawn", {})],
        [json.loads(content) for content in of_kind.get("answer", {}).values()],
        max_bytes,
    )


def _read_first_version(connection: sqlite3.Connection, max_bytes: int) -> QueueState:
    rows = connection.execute("SELECT name, value FROM meta").fetchall()
    submaps = connection.execute("SELECT content FROM submaps")
    withdrawn = connection.execute("SELECT * FROM withdrawn")
    answers = connection.execute("SELECT content FROM answers")
    return _assembled(
        {name.decode(): json.loads(value) for name, value in rows},
        [content for (content,) in submaps],
        [_submap_id((vehicle.decode(), *numbers)) for vehicle, *numbers in withdrawn],
        [json.loads(content) for (content,) in answers],
        max_bytes,
    )


def _assembled(
    meta: dict[str, Any],
    submaps: list[bytes],
    withdrawn: list[SubmapId],
    answers: list[dict[str, Any]],
    max_bytes: int,
) -> QueueState:
    anchor, lattice = meta["anchor"], meta["lattice"]
    return QueueState(
        tuple(
            sorted(
                (_submap_from_bytes(content, max_bytes) for content in submaps),
                key=lambda submap: submap.submap_id,
            )
        ),
        frozenset(withdrawn),
        tuple(_answer_from_plain(answer) for answer in answers),
        None if anchor is None else _submap_id(anchor),
        None if lattice is None else _spec_from_plain(lattice),
        tuple(_track(plain) for plain in meta["vehicles"]),
        meta["next_request_id"],
        frozenset(
            (bytes.fromhex(source), bytes.fromhex(target), tuple(prior))
            for source, target, prior in meta["standing"]
        ),
        bool(meta.get("is_pinned", True)),
    )


def _submap_id(plain: Sequence[Any]) -> SubmapId:
    """A submap's key; without a run in sessions from before there were runs."""
    vehicle, *run, sequence = plain
    return SubmapId(vehicle, run[0] if run else 0, sequence)


def _track(plain: Any) -> Track:
    """A track; only the vehicle's name in sessions from before there were runs."""
    return Track(plain, 0) if isinstance(plain, str) else Track(*plain)


_SUBMAP_SCALARS = ("vehicle_id", "run_id", "sequence", "revision", "is_final", "stamp_ns")
_SUBMAP_ARRAYS = ("covariance", "points", "trajectory", "trajectory_stamp_ns")


def _submap_header(submap: Submap) -> bytes:
    header: dict[str, Any] = {name: getattr(submap, name) for name in _SUBMAP_SCALARS}
    header["T_odom_submap"] = submap.T_odom_submap.as_array().tolist()
    header["spec"] = _spec_to_plain(submap.grid.spec)
    return json.dumps(header, sort_keys=True).encode()


def _submap_digest(submap: Submap) -> bytes:
    hasher = hashlib.blake2b(_submap_header(submap), digest_size=16)
    for array in (submap.grid.values, *(getattr(submap, name) for name in _SUBMAP_ARRAYS)):
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.digest()


def _submap_to_bytes(submap: Submap) -> bytes:
    arrays: dict[str, Any] = {n: np.asarray(getattr(submap, n)) for n in _SUBMAP_ARRAYS}
    header = np.frombuffer(_submap_header(submap), dtype=np.uint8)
    return arrays_to_bytes({"header": header, "values": submap.grid.values, **arrays})


def _submap_from_bytes(content: bytes, max_bytes: int) -> Submap:
    arrays = arrays_from_bytes(content, max_bytes)
    header = json.loads(arrays["header"].tobytes())
    grid = OccupancyMap(_spec_from_plain(header.pop("spec")), arrays["values"])
    T_odom_submap = SE2(*header.pop("T_odom_submap"))
    rest: dict[str, Any] = {name: arrays[name] for name in _SUBMAP_ARRAYS}
    return Submap(T_odom_submap=T_odom_submap, grid=grid, **header, **rest)


def _spec_to_plain(spec: GridSpec) -> list[Any]:
    return [spec.resolution_m, *spec.shape, spec.T_frame_grid.as_array().tolist()]


def _spec_from_plain(values: list[Any]) -> GridSpec:
    resolution_m, num_rows, num_cols, origin = values
    return GridSpec(resolution_m, num_rows, num_cols, SE2(*origin))


def _answer_digest(answer: Answer) -> bytes:
    source, target, prior = answer.query.key
    text = repr(prior).encode() + repr(_answer_to_plain(answer)).encode()
    return hashlib.blake2b(source + target + text, digest_size=16).digest()


def _answer_to_bytes(answer: Answer) -> bytes:
    return json.dumps(_answer_to_plain(answer)).encode()


def _answer_to_plain(answer: Answer) -> dict[str, Any]:
    prior, motion = answer.query.prior, answer.T_target_source
    return {
        "source": _group_to_plain(answer.query.source),
        "target": _group_to_plain(answer.query.target),
        "prior": prior
        and [
            prior.T_target_source.as_array().tolist(),
            prior.half_width_m,
            prior.half_width_rad,
        ],
        "verdict": int(answer.verdict),
        "reason": answer.reason,
        "T_target_source": motion and motion.as_array().tolist(),
        "covariance": answer.covariance.tolist(),
        "probability": answer.probability,
        "numbers": answer.numbers,
    }


def _answer_from_plain(plain: dict[str, Any]) -> Answer:
    prior, motion = plain["prior"], plain["T_target_source"]
    query = Query(
        _group_from_plain(plain["source"]),
        _group_from_plain(plain["target"]),
        None if prior is None else PriorWindow(SE2(*prior[0]), prior[1], prior[2]),
    )
    return Answer(
        query,
        Verdict(plain["verdict"]),
        plain["reason"],
        None if motion is None else SE2(*motion),
        np.array(plain["covariance"], dtype=np.float64),
        plain["probability"],
        plain["numbers"],
    )


def _group_to_plain(group: SubmapGroup) -> dict[str, Any]:
    members = [[*i, *T.as_array().tolist()] for i, T in group.T_reference_submap.items()]
    return {"reference": group.reference, "members": members, "key": group.key.hex()}


def _group_from_plain(plain: dict[str, Any]) -> SubmapGroup:
    members: dict[SubmapId, SE2] = {}
    for *name, x, y, yaw in plain["members"]:
        members[_submap_id(name)] = SE2(x, y, yaw)
    reference = _submap_id(plain["reference"])
    return SubmapGroup(reference, members, bytes.fromhex(plain["key"]))
