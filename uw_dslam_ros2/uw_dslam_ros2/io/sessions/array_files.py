"""Arrays in one compressed block of bytes, read without trust in the sizes that it declares."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError

__all__ = ["arrays_from_bytes", "arrays_to_bytes"]

_ENDING = ".npy"
_USUAL_HEADER_BYTES = 256
_MAX_HEADER_BYTES = 10_000


def arrays_to_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Pack named arrays, as numpy's compressed ``.npz``."""
    buffer = io.BytesIO()
    packed: dict[str, Any] = dict(arrays)
    np.savez_compressed(buffer, **packed)
    return buffer.getvalue()


def arrays_from_bytes(content: bytes, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Unpack named arrays.

    Parameters
    ----------
    content
        From `arrays_to_bytes`, or from anybody.
    max_bytes
        Most that all arrays may take together; nothing larger is allocated.

    Raises
    ------
    DataError
        If it is no such block, is damaged, or declares arrays that are too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            declared = sum(member.file_size for member in members)
            if declared > max_bytes + len(members) * _USUAL_HEADER_BYTES:
                raise DataError(f"arrays of {declared} bytes, expected at most {max_bytes}")
            return {
                member.filename.removesuffix(_ENDING): _array(archive, member)
                for member in members
            }
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise DataError(f"no block of arrays: {error}") from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as file:
        version = npy.read_magic(file)
        read_header = {
            (1, 0): npy.read_array_header_1_0,
            (2, 0): npy.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ValueError(f"{member.filename} has format {version}, expected (1, 0) or (2, 0)")
        shape, is_fortran, dtype = read_header(file, max_header_size=_MAX_HEADER_BYTES)
        if dtype.hasobject:
            raise ValueError(f"{member.filename} holds objects, expected numbers")
        num_bytes = math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or num_bytes > member.file_size:
            raise ValueError(
                f"{member.filename} declares {num_bytes} bytes of {dtype}{shape}, and holds "
                f"at most {member.file_size}"
            )
        data = file.read(num_bytes)
        if len(data) != num_bytes:
            raise ValueError(f"{member.filename} ends after {len(data)} of {num_bytes} bytes")
        if file.read(1):  # also has the member's own checksum looked at
            raise ValueError(f"{member.filename} holds more than its {num_bytes} bytes")
    return np.ndarray(shape, dtype, bytearray(data), order="F" if is_fortran else "C")
