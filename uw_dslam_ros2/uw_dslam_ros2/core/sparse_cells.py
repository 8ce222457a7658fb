"""Rectangles of cells, and values that are kept only where there are any."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["SQUARE", "SparseCells", "Window", "window_of_square"]

SQUARE = 256
"""Cells are kept in squares of so many rows and columns."""


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of lattice cells: rows ``row_0 <= row < row_1``, columns likewise."""

    row_0: int
    col_0: int
    row_1: int
    col_1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.row_1 - self.row_0, self.col_1 - self.col_0

    def union(self, other: Window) -> Window:
        """Smallest rectangle around both."""
        return Window(
            min(self.row_0, other.row_0),
            min(self.col_0, other.col_0),
            max(self.row_1, other.row_1),
            max(self.col_1, other.col_1),
        )

    def intersection(self, other: Window) -> Window:
        """What is in both; its shape is not positive if nothing is."""
        return Window(
            max(self.row_0, other.row_0),
            max(self.col_0, other.col_0),
            min(self.row_1, other.row_1),
            min(self.col_1, other.col_1),
        )

    def slices(self, inside: Window) -> tuple[slice, slice]:
        """Index of this rectangle in an array that covers `inside`."""
        return (
            slice(self.row_0 - inside.row_0, self.row_1 - inside.row_0),
            slice(self.col_0 - inside.col_0, self.col_1 - inside.col_0),
        )


def window_of_square(place: tuple[int, int]) -> Window:
    """Cells of the square in a row and column of squares."""
    row, col = place[0] * SQUARE, place[1] * SQUARE
    return Window(row, col, row + SQUARE, col + SQUARE)


@dataclass(frozen=True, slots=True, eq=False)
class SparseCells:
    """Values of a rectangle of lattice cells: by what was seen, and not by the box around it.

    Parameters
    ----------
    window
        The rectangle.
    squares
        Values (SQUARE, SQUARE) by row and column, in squares from lattice cell (0, 0); 0 where
        there is no square.
    dtype
        Of the values.
    """

    window: Window
    squares: Mapping[tuple[int, int], NDArray[Any]]
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, values: NDArray[Any]) -> SparseCells:
        """From an array (R, C), whose first cell is lattice cell (0, 0)."""
        squares = {}
        for row in range(0, values.shape[0], SQUARE):
            for col in range(0, values.shape[1], SQUARE):
                part = values[row : row + SQUARE, col : col + SQUARE]
                if part.any():
                    square = np.zeros((SQUARE, SQUARE), values.dtype)
                    square[: part.shape[0], : part.shape[1]] = part
                    squares[row // SQUARE, col // SQUARE] = square
        return cls(Window(0, 0, *values.shape), squares, values.dtype)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the rectangle."""
        return self.window.shape

    def strips(self, *, is_downward: bool = False) -> Iterator[NDArray[Any]]:
        """All values in parts of at most SQUARE rows; lowest first, or from the highest down."""
        first, last = self.window.row_0 // SQUARE, -(-self.window.row_1 // SQUARE)
        numbers = range(first, last)
        for row in reversed(numbers) if is_downward else numbers:
            around = Window(row * SQUARE, self.window.col_0, (row + 1) * SQUARE, self.window.col_1)
            strip = around.intersection(self.window)
            values = np.zeros(strip.shape, self.dtype)
            for place, square in self.squares.items():
                if place[0] == row:
                    own = window_of_square(place)
                    common = own.intersection(strip)
                    if min(common.shape) > 0:
                        values[common.slices(strip)] = square[common.slices(own)]
            yield values[::-1] if is_downward else values

    def dense(self) -> NDArray[Any]:
        """All values (R, C)."""
        return np.concatenate([np.zeros((0, self.shape[1]), self.dtype), *self.strips()])

    def at(self, row: int, col: int) -> int:
        """The value of a cell of the rectangle."""
        row, col = row + self.window.row_0, col + self.window.col_0
        square = self.squares.get((row // SQUARE, col // SQUARE))
        return 0 if square is None else int(square[row % SQUARE, col % SQUARE])
