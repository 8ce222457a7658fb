"""Reader of CARMEN logs of a 2-D laser scanner, such as that of Freiburg's building 079."""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["LOG_NAME", "LaserLog", "read_carmen_log"]

FloatArray = NDArray[np.float64]

LOG_NAME = "freiburg-079-corrected.log.gz"


@dataclass(frozen=True, slots=True, eq=False)
class LaserLog:
    """Scans of one laser and its poses, N scans of B beams.

    Angles are REP 103 yaw at the laser: x forward, counter-clockwise, the first beam to the
    right. ``poses`` are the log's corrected poses of the laser, ``odometry`` the raw ones.
    """

    angles_rad: FloatArray  # (B,)
    ranges_m: FloatArray  # (N, B), as logged; far beyond any wall where there was no echo
    poses: FloatArray  # (N, 3) [x, y, yaw]
    odometry: FloatArray  # (N, 3) [x, y, yaw]
    stamps_s: FloatArray  # (N,), from the start of the recording

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.ranges_m)

    def points(self, index: int, max_range_m: float = 40.0) -> FloatArray:
        """Echoes (K, 2) [m] of a scan in the laser's frame, up to `max_range_m`."""
        if not 0 <= index < len(self):
            raise InvalidInputError(f"scan index is {index}, expected 0 to {len(self) - 1}")
        ranges = self.ranges_m[index]
        is_echo = (ranges > 0.0) & (ranges < max_range_m)
        angles, ranges = self.angles_rad[is_echo], ranges[is_echo]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def T_map_laser(self, index: int) -> SE2:  # noqa: N802 - the name of a motion
        """Corrected pose of the laser at a scan."""
        return SE2.from_array(self.poses[index])


def read_carmen_log(path: Path) -> LaserLog:
    """Read the FLASER lines of a log, plain or gzip.

    Parameters
    ----------
    path : Path
        The file, or the folder that holds `LOG_NAME`.

    Raises
    ------
    DataError
        On a missing, truncated or foreign file; the text names the line.

    Notes
    -----
    ``FLASER n r_1 .. r_n x y yaw odom_x odom_y odom_yaw time host log_time``, n ranges over 180
    degrees: beam k points to -90 + 180 k / n degrees.
    """
    path = path / LOG_NAME if path.is_dir() else path
    scans: list[FloatArray] = []
    num_beams = 0
    for number, line in enumerate(_lines(path), start=1):
        words = line.split()
        if not words or words[0] != "FLASER":
            continue
        scan = _scan(words, f"{path}, line {number}")
        num_beams = num_beams or len(scan) - 7
        if len(scan) - 7 != num_beams:
            raise DataError(
                f"{path}, line {number}: {len(scan) - 7} ranges, expected {num_beams} as before"
            )
        scans.append(scan)
    if not scans:
        raise DataError(f"{path}: no FLASER line, so this is no CARMEN log of a laser")
    table = np.array(scans)
    angles_rad = -0.5 * math.pi + math.pi * np.arange(num_beams) / num_beams
    poses = table[:, num_beams:]
    return LaserLog(angles_rad, table[:, :num_beams], poses[:, :3], poses[:, 3:6], poses[:, 6])


def _lines(path: Path) -> list[str]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    try:
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        return content.decode("ascii").splitlines()
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path}: the gzip data is damaged or cut off ({error})") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file ({error})") from error


def _scan(words: list[str], where: str) -> FloatArray:
    """Ranges, corrected pose, odometry and stamp of a line, one array."""
    try:
        count = int(words[1])
        if count < 1 or len(words) != count + 11:
            raise DataError(
                f"{where}: {len(words)} words, expected {count + 11} for {count} ranges"
            )
        values = np.array(words[2 : count + 9], dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise DataError(f"{where}: not a FLASER line ({error})") from error
    if not np.isfinite(values).all():
        raise DataError(f"{where}: a value is not finite")
    return values
