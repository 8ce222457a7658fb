"""What a mapper has mapped, and from which pings, so that the last pass outlives the process.

A file for each run, with the records of `session_file`: each submap as it was first given away,
its pings, and its pose as it was given away last.
"""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.sessions.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.sessions.folder_lock import FolderLock
from uw_dslam_ros2.io.sessions.session_file import (
    VERSION,
    Record,
    RecordName,
    opened,
    read_records,
    write_records,
)
from uw_dslam_ros2.io.sessions.session_records import submap_from_bytes, submap_to_bytes

__all__ = ["KeptRun", "KeptRuns"]

KeptRun = tuple[list[Submap], dict[SubmapId, list[DrawnPing]]]
"""Submaps of a run in their order, as given away last, and what is kept of their pings."""
_MAX_BYTES = 1 << 28
"""Of one submap, and of its pings."""
_UNKNOWN = np.full(3, np.nan)
"""A pose."""


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
                    new["pings", key] = Record.of(_pings_to_bytes(own))
                place = submap.T_odom_submap.as_array().tolist()
                new["pose", key] = Record.of(json.dumps([submap.revision, place]).encode())
            try:
                write_records(path, held | new)
            except (sqlite3.Error, OSError) as error:
                raise DataError(f"cannot keep what is mapped in {path}: {error}") from error
            # What is written is not needed in memory any more.
            held.update((name, Record(record.digest, _lost)) for name, record in new.items())

    def load(self, path: Path) -> KeptRun:
        """One of `earlier`.

        Raises
        ------
        DataError
            Naming the file and what is wrong with it.
        """
        try:
            with opened(path) as (connection, version):
                if version != VERSION:
                    raise DataError(f"it is of format {version}, expected {VERSION}")
                records = read_records(connection)
            return _run_of(records)
        except (sqlite3.Error, OSError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path} is not a whole run: {error}") from error

    def forget(self, path: Path) -> None:
        """Remove one of `earlier`."""
        path.unlink(missing_ok=True)
        self.earlier.remove(path)

    def forget_own(self) -> None:
        """Remove the runs of this process."""
        for path in self._records:
            path.unlink(missing_ok=True)
        self._records.clear()

    def close(self) -> None:
        """Let another process have the folder."""
        self._lock.release()

    def _path_of(self, run_id: int) -> Path:
        return self._folder / f"run_{run_id}.sqlite"


def _lost() -> bytes:
    raise DataError("the file holds less than was written to it")


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
        pings[submap.submap_id] = _pings_from_bytes(records["pings", key])
    return submaps, pings


def _pings_to_bytes(pings: Sequence[DrawnPing]) -> bytes:
    return arrays_to_bytes(
        {
            "stamp_ns": np.array([p.stamp_ns for p in pings], np.int64),
            "T_submap_sonar": np.array([p.T_submap_sonar.as_array() for p in pings]),
            "T_dead_sonar": np.array(
                [_UNKNOWN if p.T_dead_sonar is None else p.T_dead_sonar.as_array() for p in pings]
            ),
            "beamwidth_rad": np.array([p.beamwidth_rad for p in pings]),
            "range_sigma_m": np.array([p.range_sigma_m for p in pings]),
            "num_points": np.array([len(p.points) for p in pings], np.int64),
            "points": np.vstack([np.empty((0, 2), np.float32), *(p.points for p in pings)]),
            "weight": np.concatenate([np.empty(0, np.float32), *(p.weight for p in pings)]),
            "num_beams": np.array([len(p.free_range_m) for p in pings], np.int64),
            "free_range_m": np.concatenate(
                [np.empty(0, np.float32), *(p.free_range_m for p in pings)]
            ),
            "bearing_rad": np.concatenate([np.empty(0), *(p.bearing_rad for p in pings)]),
        }
    )


def _pings_from_bytes(content: bytes) -> list[DrawnPing]:
    arrays = arrays_from_bytes(content, _MAX_BYTES)
    points, beams = (np.cumsum(arrays[name])[:-1] for name in ("num_points", "num_beams"))
    # Files of before do not have it.
    dead_reckoning = arrays.get("T_dead_sonar", np.full((len(arrays["stamp_ns"]), 3), np.nan))
    pings: list[DrawnPing] = []
    for stamp_ns, place, dead, beamwidth_rad, sigma_m, xy, weight, free_m, bearing_rad in zip(
        arrays["stamp_ns"].tolist(),
        arrays["T_submap_sonar"],
        dead_reckoning,
        arrays["beamwidth_rad"].tolist(),
        arrays["range_sigma_m"].tolist(),
        np.split(arrays["points"], points),
        np.split(arrays["weight"], points),
        np.split(arrays["free_range_m"], beams),
        np.split(arrays["bearing_rad"], beams),
        strict=False,  # of no ping at all there is one empty part
    ):
        if pings and np.array_equal(pings[-1].bearing_rad, bearing_rad):
            bearing_rad = pings[-1].bearing_rad  # as `pack_ping` does
        pings.append(
            DrawnPing(
                stamp_ns,
                SE2.from_array(place),
                xy,
                weight,
                bearing_rad,
                free_m,
                beamwidth_rad,
                sigma_m,
                None if np.isnan(dead).any() else SE2.from_array(dead),
            )
        )
    return pings
