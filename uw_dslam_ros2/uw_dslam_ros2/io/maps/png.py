"""PNG pictures, written row by row: a map's box is large where little of it was seen."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

__all__ = ["png_parts"]

_GREY, _INDEXED = 0, 3
_LEVEL = 6


def png_parts(
    shape: tuple[int, int],
    strips: Iterable[NDArray[np.uint8]],
    palette: NDArray[np.uint8] | None = None,
) -> Iterator[bytes]:
    """A picture of one byte a pixel, in parts.

    Parameters
    ----------
    shape
        Rows and columns.
    strips
        Pixels (K, columns) from the top.
    palette
        Colour (N, 3) of each value: red, green, blue. Without it values are grey.
    """
    num_rows, num_cols = shape
    kind = _GREY if palette is None else _INDEXED
    yield b"\x89PNG\r\n\x1a\n"
    yield _chunk(b"IHDR", struct.pack(">IIBBBBB", num_cols, num_rows, 8, kind, 0, 0, 0))
    if palette is not None:
        yield _chunk(b"PLTE", palette.tobytes())
    deflate = zlib.compressobj(_LEVEL)
    for strip in strips:
        # Each row begins with its filter: none.
        rows = np.zeros((len(strip), num_cols + 1), np.uint8)
        rows[:, 1:] = strip
        if part := deflate.compress(rows.tobytes()):
            yield _chunk(b"IDAT", part)
    yield _chunk(b"IDAT", deflate.flush())
    yield _chunk(b"IEND", b"")


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)
