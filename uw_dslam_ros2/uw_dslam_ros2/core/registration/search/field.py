"""Fields of the plane that a point is scored in, and tables of proven bounds over them.

A field is a biquadratic B-spline: coefficients on a square lattice, zero outside. Its value and
gradient are exact and continuous, it never leaves the range of the coefficients around it, and its
second derivatives are bounded cell by cell. So three questions have quick answers that are proofs
and not estimates:

* the value at a point (nine coefficients),
* an upper bound of the field over a rectangle (four look-ups in a table of range maxima),
* an upper bound of its second derivative, in any direction, over a rectangle (in another one).

What the field *means* is free: a Gaussian mixture (`mixture_field`), the logarithm of a likelihood
ratio (`likelihood_field`), or walls positive and free space negative sampled from a grid
(`field_from_samples`). Where a formula stands behind the field, `Field.error` bounds the distance
to it everywhere.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.search import field_kernels, kernels

__all__ = [
    "NUM_WINDOWS",
    "Field",
    "field_from_samples",
    "likelihood_field",
    "mixture_field",
]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_BORDER = 3  # zero coefficients around the content, so that the spline itself ends at zero
_TAIL_SIGMAS = 6.0
_BINS = 10  # on either side of a centre; beyond, a Gaussian is next to nothing
NUM_WINDOWS = 6
"""Of a table: exact maxima over rectangles of up to 63 cells a side."""


@dataclass(frozen=True, eq=False)
class Field:
    """A biquadratic B-spline over the plane, with its bound tables.

    ``coefficients[row, col]`` belongs to the node ``origin + (col, row) * pitch_m``; the nodes'
    own squares are the cells of the tables. Float32, and *exactly* what is searched: nothing is
    rounded afterwards. The outermost three nodes are zero.
    """

    origin: FloatArray  # (2,), [m], node (0, 0)
    pitch_m: float
    coefficients: Float32Array  # (R, C)
    error: float = 0.0  # proven bound of |spline - its formula|; 0 where the spline defines it

    @functools.cached_property
    def tables(self) -> tuple[Float32Array, Float32Array]:
        """Largest values and largest second derivatives [1 / m^2], made when first asked for.

        Both (6, R, C), in 2^k x 2^k cells, the squares around the nodes, from each cell on.
        """
        shape = NUM_WINDOWS, *self.coefficients.shape
        windows, curvatures = np.empty(shape, np.float32), np.empty(shape, np.float32)
        field_kernels.fill_first_level(
            self.coefficients, 1.0 / self.pitch_m**2, windows[0], curvatures[0]
        )
        field_kernels.fill_windows(windows)
        field_kernels.fill_windows(curvatures)
        return windows, curvatures

    @functools.cached_property
    def maximum(self) -> float:
        """Upper bound over the whole plane: a spline stays within its coefficients' range."""
        return max(float(self.coefficients.max()), 0.0)

    @property
    def high(self) -> FloatArray:
        """Last node (2,) [m]."""
        return self.origin + self.pitch_m * (np.array(self.coefficients.shape)[::-1] - 1)

    @property
    def num_bytes(self) -> int:
        """Memory of the coefficients and both tables."""
        return self.coefficients.nbytes * (1 + 2 * NUM_WINDOWS)

    def values(self, points: ArrayLike) -> FloatArray:
        """Values (N,) at points (N, 2) [m]."""
        return self._splines(points)[:, 0]

    def slopes(self, points: ArrayLike) -> FloatArray:
        """Slopes (N, 2) [1 / m] at points (N, 2) [m]."""
        return self._splines(points)[:, 1:] / self.pitch_m

    def _splines(self, points: ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        nodes = (points - self.origin) / self.pitch_m
        return kernels.spline_values(self.coefficients, nodes)

    def refined(self) -> Field:
        """The same function on a lattice twice as fine, by Chaikin's knot insertion.

        Its cells are the halves of the coarse ones, so the bounds are closer.
        """
        c = self.coefficients
        for axis in (0, 1):
            p = np.pad(c, [(1, 1) if k == axis else (0, 0) for k in (0, 1)])
            before = p[:-2] if axis == 0 else p[:, :-2]
            after = p[2:] if axis == 0 else p[:, 2:]
            near, far = np.float32(0.75), np.float32(0.25)
            pair = np.stack([near * c + far * before, near * c + far * after], axis=axis + 1)
            c = pair.reshape(c.shape[0] * (2 - axis), c.shape[1] * (1 + axis))
        origin = self.origin - 0.25 * self.pitch_m
        return Field(origin, 0.5 * self.pitch_m, np.ascontiguousarray(c), self.error)


def field_from_samples(samples: ArrayLike, origin: ArrayLike, pitch_m: float) -> Field:
    """Field whose lattice holds `samples` (R, C), any sign, at ``origin + (col, row) * pitch_m``.

    The spline with the samples as coefficients is their smooth average and stays within their
    range. It is the objective, and beyond the samples (after one and a half cells) it is zero.
    """
    values = np.asarray(samples, dtype=np.float64)
    if values.ndim != 2 or values.size == 0:
        raise InvalidInputError(f"samples have shape {values.shape}, expected (rows, columns)")
    if not np.isfinite(values).all():
        raise InvalidInputError("samples hold a number that is not finite")
    if not (math.isfinite(pitch_m) and pitch_m > 0.0):
        raise InvalidInputError(f"pitch_m is {pitch_m}, expected a positive number")
    padded = np.pad(values, _BORDER)
    node = np.asarray(origin, dtype=np.float64) - _BORDER * pitch_m
    return Field(node, pitch_m, padded.astype(np.float32))


def mixture_field(
    centers: FloatArray,
    weights: FloatArray,
    sigmas_m: FloatArray,
    *,
    nodes_per_sigma: float = 5.0,
    max_nodes: int = 25_000_000,
) -> Field:
    """Sum of Gaussians ``w_j exp(-|p - y_j|^2 / (2 s_j^2))``: G of equation 6.

    Parameters
    ----------
    centers : (n, 2) float64
        Means [m]; near the origin (subtract large offsets first).
    weights : (n,) float64
        Not negative.
    sigmas_m : (n,) float64
        Standard deviations of the *pair*, ``sqrt(sigma_x^2 + sigma_y^2)`` [m], > 0.
    nodes_per_sigma : float
        Lattice nodes per smallest standard deviation; the error falls with its third power.
    max_nodes : int
        The lattice is coarsened to stay below; the error then grows, and says so.
    """
    pitch_m = float(sigmas_m.min()) / nodes_per_sigma
    pitch_m, low, shape = _lattice(centers, sigmas_m, pitch_m, max_nodes)
    samples = np.zeros(shape)
    nodes, spreads = (centers - low) / pitch_m, sigmas_m / pitch_m
    field_kernels.add_gaussians(samples, nodes, weights, spreads, _TAIL_SIGMAS, True)
    coefficients = samples.astype(np.float32)
    error = _mixture_error(centers, weights, sigmas_m, pitch_m)
    error += float(np.abs(coefficients).max()) * 2.0**-23
    return Field(low, pitch_m, coefficients, error)


def likelihood_field(
    centers: FloatArray,
    weights: FloatArray,
    sigmas_m: FloatArray,
    contrast: float,
    *,
    nodes_per_sigma: float = 3.0,
    max_nodes: int = 25_000_000,
) -> Field:
    """Log of a likelihood ratio, ``log(1 + c S(p)) / log(1 + c)`` with S the mixture's field.

    A source point either belongs to one of the targets or is uniform clutter; `contrast` is the
    ratio of the two densities on top of a target. The logarithm saturates, so many targets near
    one point count little more than one. The spline through the samples is the definition of this
    field (its error is zero).
    """
    pitch_m = float(sigmas_m.min()) / nodes_per_sigma
    pitch_m, low, shape = _lattice(centers, sigmas_m, pitch_m, max_nodes)
    samples = np.zeros(shape)
    nodes, spreads = (centers - low) / pitch_m, sigmas_m / pitch_m
    field_kernels.add_gaussians(samples, nodes, weights, spreads, _TAIL_SIGMAS, False)
    np.log1p(contrast * samples, out=samples)
    samples /= math.log1p(contrast)
    coefficients = _interpolating(samples)
    coefficients[[0, 1, -2, -1], :] = 0.0
    coefficients[:, [0, 1, -2, -1]] = 0.0
    return Field(low, pitch_m, coefficients.astype(np.float32))


def _lattice(
    centers: FloatArray, sigmas_m: FloatArray, pitch_m: float, max_nodes: int
) -> tuple[float, FloatArray, tuple[int, int]]:
    """Pitch, first node and shape of a lattice that holds all Gaussians up to their tails."""
    reach = _TAIL_SIGMAS * float(sigmas_m.max())
    extent = centers.max(axis=0) - centers.min(axis=0) + 2.0 * reach
    pitch_m = max(pitch_m, math.sqrt(float(np.prod(extent)) / max_nodes))
    low = centers.min(axis=0) - reach - _BORDER * pitch_m
    num_cols, num_rows = (np.ceil(extent / pitch_m).astype(int) + 2 * _BORDER + 1).tolist()
    return pitch_m, low, (num_rows, num_cols)


def _interpolating(samples: FloatArray) -> FloatArray:
    """Coefficients (-1, 10, -1) / 8 along both axes: the spline then reproduces quadratics."""
    result = samples.copy()
    result[1:-1] = (10.0 * samples[1:-1] - samples[:-2] - samples[2:]) / 8.0
    rows = result.copy()
    result[:, 1:-1] = (10.0 * rows[:, 1:-1] - rows[:, :-2] - rows[:, 2:]) / 8.0
    return result


def _mixture_error(
    centers: FloatArray, weights: FloatArray, sigmas_m: FloatArray, pitch_m: float
) -> float:
    """Bound of the distance between the spline and the sum of Gaussians, anywhere in the plane.

    Along one axis, by Taylor's formula around the point: cubic polynomials are missed by at most
    sqrt(3) / 216 times the third derivative, and the remainder of fourth order passes the operator
    with weights that sum to 0.0293. In the plane phi(x) phi(y) - g(x) g(y) is at most E(x) g(y) +
    g(x) E(y) + E(x) E(y). The centres are counted in bins one sigma wide, and each bin adds what
    its nearest edge would.
    """
    sigma_m = float(sigmas_m.max())
    ratio = pitch_m / float(sigmas_m.min())
    if ratio > 1.0:
        # Too coarse for Taylor: no coefficient, and no value, exceeds 1.25 along an axis.
        return 1.5625 * float(weights.sum())
    miss, gauss = _misses(round(ratio * 1e9) / 1e9 + 1e-9)
    bins = np.floor((centers - centers.min(axis=0)) / sigma_m).astype(np.int64)
    counts = np.zeros(bins.max(axis=0) + 1)
    np.add.at(counts, (bins[:, 0], bins[:, 1]), weights)
    smeared = _smeared(counts, np.stack([miss, gauss]))
    both = _smeared(smeared[0].T, (miss + gauss)[None]) + _smeared(smeared[1].T, miss[None])
    return float(both.max()) + 4e-8 * float(weights.sum())


@functools.lru_cache(maxsize=64)
def _misses(ratio: float) -> tuple[FloatArray, FloatArray]:
    """By bins of distance to a centre (21,): largest miss along an axis, and largest value."""
    distance = np.maximum(np.abs(np.arange(-_BINS, _BINS + 1)) - 1.0, 0.0)
    nearest = np.maximum(distance - 2.5 * ratio, 0.0)
    third, fourth = _largest_derivatives(nearest)
    miss = third * math.sqrt(3.0) / 216.0 * ratio**3 + fourth * 0.0293 * ratio**4
    return miss, np.exp(-0.5 * distance**2)


def _smeared(counts: FloatArray, shares: FloatArray) -> FloatArray:
    """Every bin adds its count, times shares (S, 21), to those ten rows up and down: (S, ...)."""
    padded = np.pad(counts, ((2 * _BINS, 2 * _BINS), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BINS + 1, axis=0)
    return np.moveaxis(windows @ shares.T, 2, 0)


def _largest_derivatives(distance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bounds of the third and fourth derivative of exp(-x^2 / 2) at and beyond a distance."""
    beyond = distance[:, None] + np.linspace(0.0, 8.0, 1601)
    gauss = np.exp(-0.5 * beyond**2)
    third = np.abs(beyond**3 - 3.0 * beyond) * gauss
    fourth = np.abs(beyond**4 - 6.0 * beyond**2 + 3.0) * gauss
    return 1.001 * third.max(axis=1), 1.001 * fourth.max(axis=1)
