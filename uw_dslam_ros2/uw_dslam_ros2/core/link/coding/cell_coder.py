"""Marks on cells to few bytes and back: a binary range coder with mixed context models.

Whole numbers only, so that sender and receiver need not be of one make: every probability comes
out alike on every processor. The coder is one loop for both ways, which cannot disagree with
itself. (`constriction`, the library that comes to mind, takes its probabilities as floats, and one
call from Python for each adaptive symbol, of which a submap has 49,000; it is not in Ubuntu's
packages either.)
"""

from __future__ import annotations

import functools

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = [
    "CELL_FREE",
    "CELL_UNKNOWN",
    "CELL_WALL",
    "decode_marks",
    "encode_marks",
    "near_cells",
]

CellArray = NDArray[np.int8]
BoolArray = NDArray[np.bool_]

CELL_UNKNOWN, CELL_FREE, CELL_WALL = 0, 1, 2
"""Values of cells."""

_STRETCH_LIMIT = 3071  # of log-odds in units of 1/256 nat
# Number of contexts of each model, and of all those before it; see `_contexts`.
_SIZES = tuple(3**n for n in (3, 5, 7, 10, 7, 8, 6, 7, 9))
_STARTS = tuple(sum(_SIZES[:k]) for k in range(len(_SIZES) + 1))
_NUM_MODELS = len(_SIZES)
_NUM_SURE = 6  # a model's weight depends on how often it has seen the context
_FRAME = 3
_MAX_COUNT = 60
_FIRST_WEIGHT = 3 * 65536 // 10
_LEARNING_SHIFT = 14


@functools.cache
def _tables() -> tuple[NDArray[np.int64], ...]:
    """What the coder looks up.

    Where each model's contexts begin, log-odds of 12-bit probabilities, 16-bit probabilities of
    log-odds, and how far the first, second, ... sight of a context moves its probability.

    No entry lies so near to a half that the rounding could depend on a mathematical library; a
    test sees to it.
    """
    probability = (np.arange(4096) + 0.5) / 4096.0
    stretch = np.rint(256.0 * np.log(probability / (1.0 - probability))).astype(np.int64)
    odds = np.arange(-_STRETCH_LIMIT, _STRETCH_LIMIT + 1) / 256.0
    squash = np.rint(65536.0 / (1.0 + np.exp(-odds))).astype(np.int64)
    rate = 2 * 65536 // (2 * np.arange(_MAX_COUNT + 1) + 3)
    return np.array(_STARTS), stretch, np.clip(squash, 1, 65535), rate


def encode_marks(marks: BoolArray, known: CellArray, is_open: BoolArray | None = None) -> bytes:
    """Encode which cells (R, C) are marked.

    Parameters
    ----------
    marks
        The marks.
    known
        (R, C) what the receiver knows of each cell already.
    is_open
        (R, C) where marks may be, which the receiver knows too; everywhere where None.
    """
    buffer = np.zeros(2 * marks.size + 16, np.uint8)  # no bit costs more than 16
    _check(marks, known)
    num_bytes = _code(
        _framed(marks.astype(np.int8)), *_given(known, is_open), buffer, False, *_tables()
    )
    return bytes(buffer[:num_bytes]).rstrip(b"\0")


def decode_marks(data: bytes, known: CellArray, is_open: BoolArray | None = None) -> BoolArray:
    """Decode what `encode_marks` made of the same; of other bytes come other marks."""
    framed = _framed(np.zeros_like(known))
    buffer = np.frombuffer(bytearray(data), np.uint8)
    _code(framed, *_given(known, is_open), buffer, True, *_tables())
    return np.ascontiguousarray(framed[_FRAME:-_FRAME, _FRAME:-_FRAME] > 0)


def near_cells(is_there: BoolArray) -> BoolArray:
    """Which cells (R, C) are at most two from one of those."""
    import cv2  # large, so loaded when first used

    return cv2.dilate(is_there.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _given(known: CellArray, is_open: BoolArray | None) -> tuple[CellArray, CellArray]:
    """What both ends know: of each cell, and whether it may be marked."""
    open_cells = np.ones_like(known) if is_open is None else is_open.astype(np.int8)
    return _framed(known), _framed(open_cells)


def _framed(cells: CellArray) -> CellArray:
    """With unknown cells around, as far as a neighbourhood reaches."""
    framed = np.zeros((cells.shape[0] + 2 * _FRAME, cells.shape[1] + 2 * _FRAME), np.int8)
    framed[_FRAME:-_FRAME, _FRAME:-_FRAME] = cells
    return framed


def _check(marks: BoolArray, known: CellArray) -> None:
    if marks.shape != known.shape or marks.ndim != 2:
        raise InvalidInputError(
            f"marks have shape {marks.shape}, what is known of the cells {known.shape}; expected "
            "the same two sides"
        )


@njit(cache=True, nogil=True)
def _contexts(cells, coarse, row, col, found):  # type: ignore[no-untyped-def]
    """Number the neighbourhoods of a cell, of cells that came before it and of coarse ones.

    Where all neighbours are alike, as most are, returns the number of that case and no more; else
    -1.
    """
    w, n = int(cells[row, col - 1]), int(cells[row - 1, col])
    nw, ne = int(cells[row - 1, col - 1]), int(cells[row - 1, col + 1])
    ww, nn = int(cells[row, col - 2]), int(cells[row - 2, col])
    nww, nee = int(cells[row - 1, col - 2]), int(cells[row - 1, col + 2])
    here = int(coarse[row, col])
    east, south = int(coarse[row, col + 1]), int(coarse[row + 1, col])
    west, north = int(coarse[row, col - 1]), int(coarse[row - 1, col])
    south_east, south_west = int(coarse[row + 1, col + 1]), int(coarse[row + 1, col - 1])
    if w == n == nw == ne == ww == nn == nww == nee and (
        here == east == south == west == north == south_east == south_west
    ):
        return 3 * w + here
    www, nnn = int(cells[row, col - 3]), int(cells[row - 3, col])
    nnw, nne = int(cells[row - 2, col - 1]), int(cells[row - 2, col + 1])
    neee = int(cells[row - 1, col + 3])
    east_2, south_2 = int(coarse[row, col + 2]), int(coarse[row + 2, col])
    near = ((w * 3 + n) * 3 + nw) * 3 + ne
    wide = (near * 3 + ww) * 3 + nn
    found[0] = (w * 3 + n) * 3 + here
    found[1] = near * 3 + here
    found[2] = wide * 3 + here
    found[3] = (((wide * 3 + nee) * 3 + nww) * 3 + nne) * 3 + nnw
    found[4] = (((((ww * 3 + w) * 3 + www) * 3 + n) * 3 + nw) * 3 + nww) * 3 + here
    found[5] = ((((((nn * 3 + n) * 3 + nnn) * 3 + w) * 3 + nee) * 3 + ne) * 3 + neee) * 3 + here
    found[6] = ((((here * 3 + east) * 3 + south) * 3 + west) * 3 + north) * 3 + w
    found[7] = (((((here * 3 + east) * 3 + south) * 3 + south_east) * 3 + w) * 3 + n) * 3 + ne
    found[8] = (
        ((((((here * 3 + south_west) * 3 + south) * 3 + east) * 3 + w) * 3 + n) * 3 + nw) * 3
        + east_2
    ) * 3 + south_2
    return -1


@njit(cache=True, nogil=True)
def _learn(probabilities, counts, place, bit, rate):  # type: ignore[no-untyped-def]
    """Move a probability of a set bit towards what came; the less often, the farther."""
    count = int(counts[place])
    old = int(probabilities[place])
    probabilities[place] = old + (((bit * 65535 - old) * rate[count]) >> 16)
    counts[place] = min(count + 1, rate.shape[0] - 1)


@njit(cache=True, nogil=True)
def _code(  # type: ignore[no-untyped-def]
    cells, coarse, is_open, buffer, is_decoding, starts, stretch, squash, rate
):  # fmt: skip
    """Encode framed cells into the buffer, or decode them from it; returns the bytes used.

    Each open one takes a bit: whether it is more than 0.
    """
    limit = squash.shape[0] // 2
    models = starts.shape[0] - 1
    size = starts[models]
    probabilities = np.full(size, 32768, np.int32)
    counts = np.zeros(size, np.uint8)
    plain = np.full(9, 32768, np.int32)
    plain_counts = np.zeros(9, np.uint8)
    weights = np.full((models, _NUM_SURE), _FIRST_WEIGHT, np.int64)
    context = np.zeros(models, np.int64)
    inputs = np.zeros(models, np.int64)
    sure = np.zeros(models, np.int64)
    low, high, code, place = 0, 0xFFFFFFFF, 0, 0
    if is_decoding:
        for _ in range(4):
            code = (code << 8) | (buffer[place] if place < buffer.shape[0] else 0)
            place += 1
    for row in range(_FRAME, cells.shape[0] - _FRAME):
        for col in range(_FRAME, cells.shape[1] - _FRAME):
            if is_open[row, col] == 0:
                continue
            alike = _contexts(cells, coarse, row, col, context)
            if alike >= 0:
                chance = max(1, int(plain[alike]))
            else:
                mixed = 0
                for k in range(models):
                    at = starts[k] + context[k]
                    inputs[k] = stretch[probabilities[at] >> 4]
                    count = int(counts[at])
                    sure[k] = count if count < 4 else (4 if count < 12 else 5)
                    mixed += weights[k, sure[k]] * inputs[k]
                chance = squash[max(-limit, min(limit, mixed >> 16)) + limit]
            span = high - low
            middle = low + ((span >> 16) * chance + (((span & 0xFFFF) * chance) >> 16))
            if is_decoding:
                bit = 1 if code <= middle else 0
                cells[row, col] = bit
            else:
                bit = 1 if cells[row, col] > 0 else 0
            if bit == 1:
                high = middle
            else:
                low = middle + 1
            while ((low ^ high) & 0xFF000000) == 0:
                if is_decoding:
                    code = ((code & 0xFFFFFF) << 8) | (
                        buffer[place] if place < buffer.shape[0] else 0
                    )
                else:
                    buffer[place] = high >> 24
                place += 1
                low = (low & 0xFFFFFF) << 8
                high = ((high & 0xFFFFFF) << 8) | 255
            if alike >= 0:
                _learn(plain, plain_counts, alike, bit, rate)
            else:
                error = (bit << 16) - chance
                for k in range(models):
                    weights[k, sure[k]] += (inputs[k] * error) >> _LEARNING_SHIFT
                    _learn(probabilities, counts, starts[k] + context[k], bit, rate)
    if is_decoding:
        return place
    # As few bytes as name a number between the two, zeros after them.
    for num_bytes in range(5):
        mask = 0xFFFFFFFF >> (8 * num_bytes)
        if (high & ~mask) >= low or num_bytes == 4:
            for index in range(num_bytes):
                buffer[place] = (high >> (24 - 8 * index)) & 255
                place += 1
            break
    return place
