"""Aracati 2017, a forward-looking sonar in a marina, from tables (CSV) to bags.

The tables hold the detections of each key ping, velocity commands, a compass, and DGPS as truth;
perhaps also trajectories that others' software made of it, to be scored beside ours.
"""

from __future__ import annotations

import csv
import gzip
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.recordings import BagWriter
from uw_dslam_ros2.io.trajectories import write_tum

__all__ = [
    "SEGMENTS",
    "AracatiRecording",
    "read_aracati2017",
    "read_published_runs",
    "write_bag",
    "write_bags",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SEGMENTS = ((0, 220), (220, 440), (440, 664))
"""First and last key ping of the three vehicles that the recording is cut into."""

_COLUMNS = {
    "keyframes": ("keyframe_id", "time_s"),
    "detections": ("keyframe_id", "x_m", "y_m"),
    "cmd_vel": ("time_s", "vx_m_s", "wz_rad_s"),
    "compass": ("time_s", "compass_rad"),
    "dgps": ("time_s", "x_m", "y_m"),
}
_PUBLISHED_COLUMNS = ("run", "kind", "time_s", "x_m", "y_m", "yaw_rad")
# Navigation before the first and after the last key ping of a bag.
_LEAD_NS, _TAIL_NS = 2_000_000_000, 1_000_000_000
# The commands are an open-loop odometer; what it is off by slowly is the mapper's setting.
_VELOCITY_SIGMA_M_S = 0.1
_COMPASS_SIGMA_RAD = 0.03
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class AracatiRecording:
    """The recording; stamps are int64 nanoseconds since 1970, K key pings.

    ``points[k]`` (N, 2) [m] are the echoes of key ping k in the sonar's frame (x forward, y left).
    ``velocity`` is the commanded forward speed [m/s], ``yaw_rad`` ENU, ``dgps`` (D, 2) [m].
    """

    keyframe_stamp_ns: IntArray
    points: tuple[FloatArray, ...]
    velocity_stamp_ns: IntArray
    velocity_m_s: FloatArray
    compass_stamp_ns: IntArray
    yaw_rad: FloatArray
    dgps_stamp_ns: IntArray
    dgps: FloatArray

    @property
    def num_keyframes(self) -> int:
        """Number of key pings."""
        return len(self.keyframe_stamp_ns)

    def truth_at(self, stamp_ns: IntArray) -> FloatArray:
        """DGPS position and compass yaw (K, 3), interpolated; for scoring only."""
        start = int(self.dgps_stamp_ns[0])
        t = (np.asarray(stamp_ns) - start).astype(np.float64)
        known = (self.dgps_stamp_ns - start).astype(np.float64)
        x, y = (np.interp(t, known, column) for column in self.dgps.T)
        compass = (self.compass_stamp_ns - start).astype(np.float64)
        yaw = wrap_angle(np.interp(t, compass, np.unwrap(self.yaw_rad)))
        return np.column_stack([x, y, yaw])


def read_aracati2017(folder: str | Path) -> AracatiRecording:
    """Read the tables ``<name>.csv.gz`` (or ``.csv``) of a folder.

    Raises
    ------
    DataError
        Naming the file and what is missing or wrong in it.
    """
    tables = {name: _table(Path(folder), name) for name in _COLUMNS}
    keyframes, detections = tables["keyframes"], tables["detections"]
    ids = keyframes[:, 0].astype(np.int64)
    if not np.array_equal(ids, np.arange(len(ids))):
        raise DataError(f"{folder}: keyframe_id of keyframes must count 0, 1, 2, ...")
    owner = detections[:, 0].astype(np.int64)
    if len(owner) and (owner.min() < 0 or owner.max() >= len(ids)):
        raise DataError(f"{folder}: detections name keyframe {owner.max()}, there are {len(ids)}")
    order = np.argsort(owner, kind="stable")
    cuts = np.searchsorted(owner[order], np.arange(1, len(ids)))
    return AracatiRecording(
        _nanoseconds(keyframes[:, 1]),
        tuple(np.split(detections[order, 1:], cuts)),
        _nanoseconds(tables["cmd_vel"][:, 0]),
        tables["cmd_vel"][:, 1],
        _nanoseconds(tables["compass"][:, 0]),
        # Clockwise from north; from here on counter-clockwise from east.
        wrap_angle(np.pi / 2.0 - tables["compass"][:, 1]),
        _nanoseconds(tables["dgps"][:, 0]),
        tables["dgps"][:, 1:],
    )


def read_published_runs(folder: str | Path) -> dict[str, tuple[IntArray, FloatArray]]:
    """Trajectories of others' runs on this recording, by "kind, run"; none where no table is.

    Each is stamps (K,) [ns] and poses (K, 3) [x, y, yaw] in a frame of its own: never an input.

    Raises
    ------
    DataError
        Naming the file and what is wrong in it.
    """
    path = _table_path(Path(folder), "bruce_runs")
    if not path.exists():
        return {}
    rows: dict[str, list[list[float]]] = {}
    for number, words in enumerate(_rows(path, _PUBLISHED_COLUMNS), start=2):
        if len(words) != len(_PUBLISHED_COLUMNS):
            raise DataError(f"{path}, line {number}: {len(words)} columns, expected 6")
        rows.setdefault(f"{words[1]}, {words[0]}", []).append(
            _numbers(path, number, words[2:]),
        )
    tables = {name: np.array(values, dtype=np.float64) for name, values in sorted(rows.items())}
    return {name: (_nanoseconds(table[:, 0]), table[:, 1:]) for name, table in tables.items()}


def write_bags(
    recording: AracatiRecording,
    folder: str | Path,
    *,
    storage: str = "mcap",
    progress: Progress | None = None,
) -> list[Path]:
    """Write ``auv_1`` to ``auv_3`` (see `SEGMENTS`) and, under ``whole``, one bag of everything.

    The truth goes to ``truth/<vehicle>.tum`` beside the bags; returns the bags' folders.
    """
    folder = Path(folder)
    jobs = [(folder, f"auv_{i + 1}", span) for i, span in enumerate(SEGMENTS)]
    jobs.append((folder / "whole", "auv_1", (0, recording.num_keyframes - 1)))
    bags = []
    for done, (parent, vehicle_id, span) in enumerate(jobs):
        if progress is not None:
            progress(done, len(jobs))
        bags.append(write_bag(recording, parent, vehicle_id, span, storage=storage))
    return bags


def write_bag(
    recording: AracatiRecording,
    folder: Path,
    vehicle_id: str,
    span: tuple[int, int],
    *,
    storage: str = "mcap",
) -> Path:
    """Write key pings first to last (inclusive) as the bag ``folder/vehicle_id``.

    Raises
    ------
    InvalidInputError
        If the recording has no such key pings.
    """
    first, last = span
    if not 0 <= first < last < recording.num_keyframes:
        raise InvalidInputError(
            f"span is {span}, expected rising keyframes below {recording.num_keyframes}"
        )
    low = int(recording.keyframe_stamp_ns[first]) - _LEAD_NS
    high = int(recording.keyframe_stamp_ns[last]) + _TAIL_NS
    path = folder / vehicle_id
    with BagWriter(path, storage) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
        writer.add_topic(f"/{vehicle_id}/points", "sensor_msgs/msg/PointCloud2")
        writer.add_topic(f"/{vehicle_id}/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped")
        writer.add_topic(f"/{vehicle_id}/imu", "sensor_msgs/msg/Imu")
        writer.add_topic(f"/{vehicle_id}/truth/odom", "nav_msgs/msg/Odometry")
        mounts = [
            (f"{vehicle_id}/sonar", (0.0, 0.0, 0.0), _NO_ROTATION),
            (f"{vehicle_id}/imu", (0.0, 0.0, 0.0), _NO_ROTATION),
        ]
        transforms = make.transforms(low, f"{vehicle_id}/base_link", mounts)
        writer.write("/tf_static", low, transforms)
        for stamp_ns, topic, message in _messages(recording, make, vehicle_id, first, last):
            if low <= stamp_ns <= high:
                writer.write(f"/{vehicle_id}/{topic}", stamp_ns, message)
    stamps = recording.dgps_stamp_ns
    stamps = stamps[(stamps >= low) & (stamps <= high)]
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    write_tum(folder / "truth" / f"{vehicle_id}.tum", stamps, recording.truth_at(stamps))
    return path


def _messages(
    recording: AracatiRecording, make: MessageFactory, vehicle_id: str, first: int, last: int
) -> Iterator[tuple[int, str, Any]]:
    """All messages in order of time; at one stamp navigation comes before the ping."""
    base, sonar, imu = (f"{vehicle_id}/{name}" for name in ("base_link", "sonar", "imu"))
    twist_covariance = np.zeros((6, 6))
    twist_covariance[0, 0] = twist_covariance[1, 1] = _VELOCITY_SIGMA_M_S**2
    pings = recording.keyframe_stamp_ns[first : last + 1]
    truth = recording.truth_at(recording.dgps_stamp_ns)
    order = sorted(
        [(int(t), 0, i) for i, t in enumerate(recording.velocity_stamp_ns)]
        + [(int(t), 1, i) for i, t in enumerate(recording.compass_stamp_ns)]
        + [(int(t), 2, i) for i, t in enumerate(recording.dgps_stamp_ns)]
        + [(int(t), 3, first + i) for i, t in enumerate(pings)]
    )
    for t, kind, i in order:
        if kind == 0:
            velocity = (float(recording.velocity_m_s[i]), 0.0)
            yield t, "dvl", make.twist(t, base, velocity, 0.0, twist_covariance)
        elif kind == 1:
            yaw = float(recording.yaw_rad[i])
            yield t, "imu", make.imu(t, imu, yaw, _COMPASS_SIGMA_RAD**2, None, 0.0)
        elif kind == 2:
            pose = SE2.from_array(truth[i])
            yield t, "truth/odom", make.odometry(t, "map", base, pose, 0.0, (0.0, 0.0), 0.0)
        else:
            yield t, "points", make.points(t, sonar, recording.points[i])


def _table(folder: Path, name: str) -> FloatArray:
    columns = _COLUMNS[name]
    path = _table_path(folder, name)
    lines = _rows(path, columns)
    rows = [_numbers(path, number, words) for number, words in enumerate(lines, start=2)]
    if any(len(row) != len(columns) for row in rows):
        raise DataError(f"{path}: expected {len(columns)} numbers in each line")
    if not rows:
        raise DataError(f"{path} has no rows")
    return np.array(rows, dtype=np.float64)


def _table_path(folder: Path, name: str) -> Path:
    path = folder / f"{name}.csv.gz"
    return path if path.exists() else folder / f"{name}.csv"


def _rows(path: Path, columns: tuple[str, ...]) -> list[list[str]]:
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
    except FileNotFoundError as error:
        raise DataError(f"{path}.gz is missing") from error
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read: {error}") from error
    lines = text.splitlines()
    if not lines or tuple(lines[0].strip().split(",")) != columns:
        raise DataError(f"{path}: line 1 must be {','.join(columns)}")
    return list(csv.reader(lines[1:]))


def _numbers(path: Path, number: int, words: list[str]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{path}, line {number}: {error}") from error
    if not np.isfinite(values).all():
        raise DataError(f"{path}, line {number}: {','.join(words)} is not finite")
    return values


def _nanoseconds(time_s: FloatArray) -> IntArray:
    # The tables have milliseconds; more digits of a double would be noise.
    return np.rint(time_s * 1e3).astype(np.int64) * 1_000_000
