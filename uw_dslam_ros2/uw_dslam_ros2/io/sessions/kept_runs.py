"""What a mapper has mapped, and from which pings, so that the last pass outlives the process.

A file for each run, with the records of `session_file`: each submap as it was first given away,
its pings, and its pose as it was given away last. What is in the open submap is in `open_submap`.
"""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.mapping.mapper_state import HeldSubmaps, MapperState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.sessions.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.sessions.folder_lock import FolderLock
from uw_dslam_ros2.io.sessions.open_submap import OpenSubmapFile
from uw_dslam_ros2.io.sessions.ping_arrays import arrays_of_pings, pings_of_arrays
from uw_dslam_ros2.io.sessions.session_file import (
    VERSION,
    Record,
    RecordName,
    opened,
    read_records,
    write_records,
)
from uw_dslam_ros2.io.sessions.session_records import submap_from_bytes, submap_to_bytes

__all__ = ["KeptRun", "KeptRuns", "ResumedRun"]

KeptRun = tuple[list[Submap], dict[SubmapId, list[DrawnPing]]]
"""Submaps of a run in their order, as given away last, and what is kept of their pings."""
_MAX_BYTES = 1 << 28
"""Of one submap, and of its pings."""
_LEAST_WEIGHT = 0.1
"""Of a point: there is one where something was heard."""


@dataclass(frozen=True, slots=True, eq=False)
class ResumedRun:
    """A run to go on with."""

    state: MapperState
    held: HeldSubmaps
    pings: dict[SubmapId, list[DrawnPing]]
    """Of all its submaps, the open one included."""
    records: dict[RecordName, Record]
    """Of its file."""


class KeptRuns:
    """The runs of one vehicle in a folder, which one process at a time may have.

    Parameters
    ----------
    folder
        Made where it is missing.

    Raises
    ------
    SessionInUseError
        If another process has the folder.
    DataError
        If nothing can be written there.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._lock = FolderLock(self._folder, "mapper")
        self._lock.acquire()
        self.earlier = sorted(self._folder.glob("run_*.sqlite"))
        """Files of processes before this one."""
        self._records: dict[Path, dict[RecordName, Record]] = {}
        self._open = OpenSubmapFile(self._folder / "open_submap")

    def save(
        self, submaps: Sequence[Submap], pings: Mapping[SubmapId, Sequence[DrawnPing]]
    ) -> None:
        """Keep submaps that are about to be given away, of a run of this process.

        Raises
        ------
        DataError
            If the disk does not take them; what is kept is then as before.
        """
        for path in {self._path_of(submap.run_id) for submap in submaps}:
            held = self._records.setdefault(path, {})
            new: dict[RecordName, Record] = {}
            for submap in submaps:
                if self._path_of(submap.run_id) != path:
                    continue
                key = f"{submap.sequence:06d}"
                if ("submap", key) not in held:
                    own = pings.get(submap.submap_id, ())
                    new["submap", key] = Record.of(submap_to_bytes(submap))
                    new["pings", key] = Record.of(arrays_to_bytes(arrays_of_pings(own)))
                place = submap.T_odom_submap.as_array().tolist()
                new["pose", key] = Record.of(json.dumps([submap.revision, place]).encode())
            try:
                write_records(path, held | new)
            except (sqlite3.Error, OSError) as error:
                raise DataError(f"cannot keep what is mapped in {path}: {error}") from error
            # What is written is not needed in memory any more.
            held.update((name, Record(record.digest, _lost)) for name, record in new.items())

    def save_open(
        self, mapper: VehicleMapper, pings: Mapping[SubmapId, Sequence[DrawnPing]], setup: bytes
    ) -> None:
        """Keep what is in the open submap by now, and what is needed to go on from there.

        Parameters
        ----------
        mapper
            All of whose closed submaps are kept.
        pings
            Of its submaps.
        setup
            Digest of what another mapper must be set to, to go on from there.

        Raises
        ------
        DataError
            If the disk does not take it.
        """
        self._open.write(mapper, pings, setup)

    def forget_open(self) -> None:
        """From now on no run can be gone on with."""
        self._open.remove()

    def resume(self, vehicle_id: str, setup: bytes) -> ResumedRun | None:
        """The run of the process before, if it can be gone on with: `take` it then.

        Raises
        ------
        DataError
            Naming what is damaged, or not whole.
        """
        kept = self._open.read(setup)
        if kept is None:
            return None
        state, open_pings = kept
        path = self._path_of(state.run_id)
        records, (submaps, pings) = self._read(path) if path in self.earlier else ({}, ([], {}))
        num = len(submaps)
        if [s.sequence for s in submaps] != list(range(num)) or num - state.sequence not in (0, 1):
            raise DataError(
                f"{path} holds {num} submaps, expected {state.sequence} from the first"
            )
        if num == state.sequence:
            pings[SubmapId(vehicle_id, state.run_id, num)] = open_pings
        known = {
            name: Record(Record.of(content).digest, _lost) for name, content in records.items()
        }
        closed = [(s, _weight_of(s, pings[s.submap_id])) for s in submaps]
        drawn = [(ping.detections(), ping.T_submap_sonar) for ping in open_pings]
        return ResumedRun(state, HeldSubmaps(closed, drawn), pings, known)

    def take(self, run: ResumedRun) -> None:
        """A run that was resumed is one of this process."""
        path = self._path_of(run.state.run_id)
        if path in self.earlier:
            self.earlier.remove(path)
            self._records[path] = run.records

    def load(self, path: Path) -> KeptRun:
        """One of `earlier`.

        Raises
        ------
        DataError
            Naming the file and what is wrong with it.
        """
        return self._read(path)[1]

    def forget(self, path: Path) -> None:
        """Remove one of `earlier`."""
        path.unlink(missing_ok=True)
        self.earlier.remove(path)

    def forget_own(self) -> None:
        """Remove the runs of this process."""
        self._open.remove()
        for path in self._records:
            path.unlink(missing_ok=True)
        self._records.clear()

    def close(self) -> None:
        """Let another process have the folder."""
        self._lock.release()

    def _read(self, path: Path) -> tuple[dict[RecordName, bytes], KeptRun]:
        """A file's records, and what they say."""
        try:
            with opened(path) as (connection, version):
                if version != VERSION:
                    raise DataError(f"it is of format {version}, expected {VERSION}")
                records = read_records(connection)
            return records, _run_of(records)
        except (sqlite3.Error, OSError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path} is not a whole run: {error}") from error

    def _path_of(self, run_id: int) -> Path:
        return self._folder / f"run_{run_id}.sqlite"


def _lost() -> bytes:
    raise DataError("the file holds less than was written to it")


def _weight_of(submap: Submap, pings: Sequence[DrawnPing]) -> NDArray[np.float64]:
    """Weights (N,) of a submap's points: those of the echoes that lie nearest to each."""
    num = len(submap.points)
    if num == 0 or not pings:
        return np.full(num, _LEAST_WEIGHT)
    echoes = [ping.T_submap_sonar.apply(ping.points.astype(np.float64)) for ping in pings]
    _, nearest = scipy.spatial.cKDTree(submap.points).query(np.vstack(echoes))
    heard = np.concatenate([ping.weight for ping in pings])
    return np.maximum(np.bincount(nearest, heard, num), _LEAST_WEIGHT)


def _run_of(records: Mapping[RecordName, bytes]) -> KeptRun:
    submaps: list[Submap] = []
    pings: dict[SubmapId, list[DrawnPing]] = {}
    for (kind, key), content in sorted(records.items()):
        if kind != "submap":
            continue
        revision, place = json.loads(records["pose", key])
        first = submap_from_bytes(content, _MAX_BYTES)
        submap = dataclasses.replace(first, revision=revision, T_odom_submap=SE2(*place))
        submaps.append(submap)
        arrays = arrays_from_bytes(records["pings", key], _MAX_BYTES)
        pings[submap.submap_id] = pings_of_arrays(arrays)
    return submaps, pings
