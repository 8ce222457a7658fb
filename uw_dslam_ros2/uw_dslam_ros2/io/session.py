"""Sessions: what a map queue knows, kept on disk so that it outlives the process.

A session is a folder with an SQLite file. Saving writes what is new in one transaction: a process
that is killed at any point leaves the session as it was before or as it is after.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import sqlite3
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import ConstraintKind, MapQueue, MapQueueConfig, QueueState
from uw_dslam_ros2.core.merging.answers import Answer, Query
from uw_dslam_ros2.core.merging.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track, track_name
from uw_dslam_ros2.io.maps import write_map
from uw_dslam_ros2.io.provenance import write_provenance
from uw_dslam_ros2.io.trajectories import PoseGraphEdge, write_g2o, write_tum

__all__ = ["SESSION_FILE", "UNSURE_EDGE", "export_queue", "load_session", "save_session"]

SESSION_FILE = "session.sqlite"
UNSURE_EDGE = "refused by itself; believed because others agree with it"
"""Comment on an edge of a pose graph."""
_VERSION = 1
_TABLES = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS submaps (
    vehicle_id TEXT, run_id INTEGER, sequence INTEGER, digest BLOB NOT NULL,
    content BLOB NOT NULL, PRIMARY KEY (vehicle_id, run_id, sequence));
CREATE TABLE IF NOT EXISTS withdrawn (
    vehicle_id TEXT, run_id INTEGER, sequence INTEGER,
    PRIMARY KEY (vehicle_id, run_id, sequence));
CREATE TABLE IF NOT EXISTS answers (digest BLOB PRIMARY KEY, content TEXT NOT NULL);
"""


def save_session(folder: str | Path, queue: MapQueue) -> Path:
    """Make the session in a folder equal to the queue; costs what has changed since the last time.

    Returns
    -------
    Path
        The session's file.

    Raises
    ------
    DataError
        Naming the file and the reason; the session is then as it was.
    """
    path = Path(folder) / SESSION_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _opened(path) as connection:
            _create(connection, path)
            connection.execute("BEGIN IMMEDIATE")
            try:
                _write(connection, queue.to_state())
                connection.execute("COMMIT")
            except BaseException:
                connection.rollback()
                raise
    except (sqlite3.Error, OSError) as error:
        raise DataError(f"cannot save the session {path}: {error}") from error
    return path


def load_session(folder: str | Path, config: MapQueueConfig | None = None) -> MapQueue:
    """Go on from a saved session.

    Raises
    ------
    DataError
        Naming the file and what is wrong with it.
    """
    path = Path(folder) / SESSION_FILE
    if not path.is_file():
        raise DataError(f"there is no session: {path} does not exist")
    try:
        with _opened(path) as connection:
            _check_version(connection, path)
            state = _read(connection)
        return MapQueue.from_state(state, config)
    except (sqlite3.Error, zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} is not a whole session: {error}") from error


def export_queue(folder: str | Path, queue: MapQueue) -> list[Path]:
    """Write a queue for other programs; missing folders are made.

    ``map.{yaml,pgm,png}`` (global map), ``map_contradictions.png`` and ``map_provenance.npz`` (who
    saw what, see `write_provenance`), ``submaps/<vehicle>_<sequence>.*`` (each in its own
    frame), ``trajectories/<vehicle>.tum`` (merged vehicles, in "map"), ``graph.g2o`` (the global
    component, without the edges found wrong).
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
    for record in records:
        submap = record.submap
        name = f"{_file_name(track_name(submap.submap_id.track))}_{submap.sequence:04d}"
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
            _regular(c.covariance) if c.kind is ConstraintKind.ODOMETRY else c.covariance,
            UNSURE_EDGE if c.is_unsure else "",
        )
        for c in queue.constraints()
        if c.is_inlier and c.source in keys and c.target in keys
    ]
    return [*written, write_g2o(folder / "graph.g2o", vertices, edges)]


def _regular(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Odometry may claim to be perfect; a g2o file needs an inverse."""
    return covariance + np.diag([1e-6, 1e-6, 1e-8])


def _file_name(vehicle_id: str) -> str:
    """Keep a vehicle's name from leaving its folder."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in vehicle_id).lstrip(".") or "_"


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(path, isolation_level=None)
    try:
        yield connection
    finally:
        connection.close()


def _create(connection: sqlite3.Connection, path: Path) -> None:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    columns = [row[1] for row in connection.execute("PRAGMA table_info(submaps)")]
    if version == 0 or "run_id" not in columns:
        connection.execute("BEGIN IMMEDIATE")
        if version:
            # From before there were runs. All is written anew, in the same transaction or none.
            connection.execute("DROP TABLE submaps")
            connection.execute("DROP TABLE withdrawn")
        for statement in filter(str.strip, _TABLES.split(";")):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {_VERSION}")
        connection.execute("COMMIT")
    _check_version(connection, path)


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version != _VERSION:
        raise DataError(f"{path} is a session of format {version}, expected {_VERSION}")


def _write(connection: sqlite3.Connection, state: QueueState) -> None:
    _write_submaps(connection, state)
    connection.execute("DELETE FROM withdrawn")
    for submap_id in sorted(state.withdrawn):
        connection.execute("INSERT INTO withdrawn VALUES (?, ?, ?)", submap_id)
    held = {row[0] for row in connection.execute("SELECT digest FROM answers")}
    wanted = {_answer_digest(answer): answer for answer in state.answers}
    for digest in sorted(held - set(wanted)):
        connection.execute("DELETE FROM answers WHERE digest = ?", (digest,))
    for digest in sorted(set(wanted) - held):
        content = json.dumps(_answer_to_plain(wanted[digest]))
        connection.execute("INSERT INTO answers VALUES (?, ?)", (digest, content))
    meta = {
        "anchor": state.anchor,
        "lattice": None if state.lattice is None else _spec_to_plain(state.lattice),
        "vehicles": state.tracks,
        "next_request_id": state.next_request_id,
        "standing": [[s.hex(), t.hex(), prior] for s, t, prior in sorted(state.standing)],
        "is_pinned": state.is_pinned,
    }
    for name, value in meta.items():
        row = name, json.dumps(value)
        connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", row)


def _write_submaps(connection: sqlite3.Connection, state: QueueState) -> None:
    rows = connection.execute("SELECT vehicle_id, run_id, sequence, digest FROM submaps")
    held = {SubmapId(*name): digest for *name, digest in rows}
    for submap_id in sorted(set(held) - {submap.submap_id for submap in state.submaps}):
        where = "WHERE vehicle_id = ? AND run_id = ? AND sequence = ?"
        connection.execute(f"DELETE FROM submaps {where}", submap_id)
    for submap in state.submaps:
        digest = _submap_digest(submap)
        if held.get(submap.submap_id) != digest:
            row = (*submap.submap_id, digest, _submap_to_bytes(submap))
            connection.execute("INSERT OR REPLACE INTO submaps VALUES (?, ?, ?, ?, ?)", row)


def _read(connection: sqlite3.Connection) -> QueueState:
    meta = {name: json.loads(v) for name, v in connection.execute("SELECT name, value FROM meta")}
    submaps = connection.execute("SELECT content FROM submaps")
    answers = connection.execute("SELECT content FROM answers")
    anchor, lattice = meta["anchor"], meta["lattice"]
    return QueueState(
        tuple(sorted((_submap_from_bytes(content) for (content,) in submaps), key=_by_submap_id)),
        frozenset(_submap_id(row) for row in connection.execute("SELECT * FROM withdrawn")),
        tuple(_answer_from_plain(json.loads(content)) for (content,) in answers),
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


def _by_submap_id(submap: Submap) -> SubmapId:
    return submap.submap_id


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
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {n: np.asarray(getattr(submap, n)) for n in _SUBMAP_ARRAYS}
    header = np.frombuffer(_submap_header(submap), dtype=np.uint8)
    np.savez_compressed(buffer, header=header, values=submap.grid.values, **arrays)
    return buffer.getvalue()


def _submap_from_bytes(content: bytes) -> Submap:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        header = json.loads(arrays["header"].tobytes())
        grid = OccupancyMap(_spec_from_plain(header.pop("spec")), arrays["values"])
        T_odom_submap = SE2(*header.pop("T_odom_submap"))
        rest = {name: arrays[name] for name in _SUBMAP_ARRAYS}
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
