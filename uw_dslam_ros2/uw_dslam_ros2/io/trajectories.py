"""Trajectories (TUM) and pose graphs (g2o) on disk, as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.atomic import write_files

__all__ = [
    "PoseGraphEdge",
    "g2o_bytes",
    "invertible",
    "read_g2o",
    "read_tum",
    "tum_bytes",
    "write_g2o",
    "write_tum",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NS_PER_S = 1_000_000_000
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphEdge:
    """``T_target_source`` between two vertices; covariance (3, 3) of x, y, yaw, target's frame."""

    target: int
    source: int
    T_target_source: SE2
    covariance: FloatArray
    comment: str = ""  # one line; written before the edge, and passed over by readers


def tum_bytes(stamps_ns: IntArray, poses: FloatArray) -> bytes:
    """Lines ``time x y z qx qy qz qw`` of stamps (K,) [ns] and poses (K, 3) [x, y, yaw]."""
    stamps, poses = np.asarray(stamps_ns), np.asarray(poses, dtype=np.float64)
    if poses.shape != (len(stamps), 3):
        raise InvalidInputError(f"poses have shape {poses.shape}, expected ({len(stamps)}, 3)")
    lines = []
    for stamp, (x, y, yaw) in zip(stamps.tolist(), poses.tolist(), strict=True):
        seconds, rest = divmod(stamp, _NS_PER_S)
        if seconds < 0:
            raise InvalidInputError(f"stamp is {stamp} ns, expected a time from 0 on")
        half = 0.5 * yaw
        lines.append(
            f"{seconds}.{rest:09d} {x:.9f} {y:.9f} 0 0 0 "
            f"{math.sin(half):.12f} {math.cos(half):.12f}\n"
        )
    return "".join(lines).encode()


def write_tum(path: str | Path, stamps_ns: IntArray, poses: FloatArray) -> Path:
    """Write a trajectory; see `tum_bytes`."""
    return write_files({Path(path): tum_bytes(stamps_ns, poses)})[0]


def read_tum(path: str | Path) -> tuple[IntArray, FloatArray]:
    """Read stamps (K,) [ns] and poses (K, 3) [x, y, yaw]; z, roll and pitch are dropped.

    Raises
    ------
    DataError
        Naming the file, the line and what is wrong with it.
    """
    path = Path(path)
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for number, words in _lines(path):
        if len(words) != 8:
            raise DataError(
                f"{path}:{number} has {len(words)} numbers, expected 8: time x y z qx qy qz qw"
            )
        x, y, _, qx, qy, qz, qw = _floats(path, number, words[1:])
        try:
            stamps.append(int((Decimal(words[0]) * _NS_PER_S).to_integral_value()))
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise DataError(f"{path}:{number}: time is {words[0]!r}, expected seconds") from error
        if qx == qy == qz == qw == 0.0:
            raise DataError(f"{path}:{number}: the quaternion is zero")
        poses.append(
            (x, y, math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz))
        )
    return np.array(stamps, dtype=np.int64), np.array(poses, dtype=np.float64).reshape(-1, 3)


def g2o_bytes(vertices: Mapping[int, SE2], edges: Sequence[PoseGraphEdge]) -> bytes:
    """A planar pose graph; information in the source's axes, as g2o takes it."""
    lines = [f"VERTEX_SE2 {key} {p.x:.9g} {p.y:.9g} {p.yaw:.12g}\n" for key, p in vertices.items()]
    for edge in edges:
        for key in (edge.target, edge.source):
            if key not in vertices:
                raise InvalidInputError(
                    f"edge {edge.target} - {edge.source} names vertex {key}, which is missing"
                )
        to_source = _rotation3(edge.T_target_source).T
        information = np.linalg.inv(to_source @ edge.covariance @ to_source.T)
        numbers = " ".join(f"{v:.12g}" for v in information[_UPPER])
        motion = edge.T_target_source
        if edge.comment:
            lines.append(f"# {edge.comment}\n")
        lines.append(
            f"EDGE_SE2 {edge.target} {edge.source} "
            f"{motion.x:.9g} {motion.y:.9g} {motion.yaw:.12g} {numbers}\n"
        )
    return "".join(lines).encode()


def invertible(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) with an inverse, which a file needs; odometry may claim to be perfect."""
    return covariance + np.diag([1e-6, 1e-6, 1e-8])


def write_g2o(
    path: str | Path, vertices: Mapping[int, SE2], edges: Sequence[PoseGraphEdge]
) -> Path:
    """Write a pose graph; see `g2o_bytes`."""
    return write_files({Path(path): g2o_bytes(vertices, edges)})[0]


def read_g2o(path: str | Path) -> tuple[dict[int, SE2], list[PoseGraphEdge]]:
    """Read the ``VERTEX_SE2`` and ``EDGE_SE2`` lines of a g2o file; other tags are passed over.

    Raises
    ------
    DataError
        Naming the file, the line and what is wrong with it.
    """
    path = Path(path)
    vertices: dict[int, SE2] = {}
    edges: list[PoseGraphEdge] = []
    for number, words in _lines(path):
        if words[0] == "VERTEX_SE2":
            _check_length(path, number, words, 5)
            x, y, yaw = _floats(path, number, words[2:])
            vertices[_integer(path, number, words[1])] = SE2(x, y, yaw)
        elif words[0] == "EDGE_SE2":
            _check_length(path, number, words, 12)
            numbers = _floats(path, number, words[3:])
            motion = SE2(*numbers[:3])
            information = np.zeros((3, 3))
            information[_UPPER] = numbers[3:]
            information = information + np.triu(information, 1).T
            if np.linalg.eigvalsh(information)[0] <= 0.0:
                raise DataError(
                    f"{path}:{number}: the information matrix is not positive definite"
                )
            to_target = _rotation3(motion)
            covariance = to_target @ np.linalg.inv(information) @ to_target.T
            target, source = (_integer(path, number, word) for word in words[1:3])
            edges.append(PoseGraphEdge(target, source, motion, covariance))
    return vertices, edges


def _rotation3(motion: SE2) -> FloatArray:
    rotation = np.eye(3)
    rotation[:2, :2] = motion.rotation()
    return rotation


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not a text file") from error
    split = [(number, line.split()) for number, line in enumerate(text.splitlines(), start=1)]
    return [(number, words) for number, words in split if words and not words[0].startswith("#")]


def _check_length(path: Path, number: int, words: list[str], expected: int) -> None:
    if len(words) != expected:
        raise DataError(
            f"{path}:{number}: {words[0]} has {len(words) - 1} values, expected {expected - 1}"
        )


def _floats(path: Path, number: int, words: Sequence[str]) -> list[float]:
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError as error:
            raise DataError(f"{path}:{number}: {word!r} is not a number") from error
        if not math.isfinite(value):
            raise DataError(f"{path}:{number}: {word!r} is not finite")
        values.append(value)
    return values


def _integer(path: Path, number: int, word: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise DataError(f"{path}:{number}: {word!r} is not a vertex number") from error
