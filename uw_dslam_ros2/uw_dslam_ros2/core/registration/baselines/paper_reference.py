"""The paper's registration, equation by equation, in plain NumPy: the oracle, not the engine.

Source: Zhang, Xu and Cheng, "An Underwater Distributed SLAM Approach Based on Improved GMRBnB
Framework" (2023), section 3.3. Signs are the paper's: E is *minimised*, so E <= 0 and the best
pose has the most negative value; the engine maximises f = -E.

Three places need a reading that the printed text does not give (docs/method.md derives them, the
tests check them):

* Eqs. 4 and 5 bound the residual only with ``Y_j`` taken relative to the box's translation centre,
  ``rho`` the half *diagonal* of the translation square and ``beta`` the half width of the rotation
  interval. `printed_residual_bound` keeps the letter of eq. 4, so that a test can show that it is
  not a bound.
* ``N`` follows from eq. 3 as ``2 pi (sigma_i^2 + sigma_j^2)``.
* In Algorithm 3 the ``if`` of line 3 is a loop, and line 10 removes ``B_k`` from the list xi.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = [
    "Boxes",
    "MixturePair",
    "ReferenceResult",
    "initial_box",
    "lower_bound",
    "objective",
    "printed_residual_bound",
    "register_reference",
    "residual_lower_bound",
    "residuals",
    "upper_bound",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MixturePair:
    """Two Gaussian mixtures G_X and G_Y, as the objective needs them.

    ``source`` (m, 2) and ``target`` (n, 2) are the means X_i and Y_j [m], ``weights`` (m, n) holds
    w_i w_j / N_ij and ``variances`` (m, n) holds sigma_i^2 + sigma_j^2 [m^2].
    """

    source: FloatArray
    target: FloatArray
    weights: FloatArray
    variances: FloatArray

    @classmethod
    def build(
        cls,
        source: ArrayLike,
        target: ArrayLike,
        sigma_m: float = 0.1,
        *,
        source_weights: ArrayLike | None = None,
        target_weights: ArrayLike | None = None,
        source_sigma_m: ArrayLike | None = None,
        target_sigma_m: ArrayLike | None = None,
        is_density: bool = False,
    ) -> MixturePair:
        """Pair two point sets.

        Parameters
        ----------
        source, target : (m, 2) and (n, 2)
            Means [m], at least one each.
        sigma_m : float
            Standard deviation [m] of every component whose own is not given; the paper's value is
            0.1.
        source_weights, target_weights : (m,) and (n,), optional
            Not negative; divided by their sum. Equal by default, so that w_i w_j = 1 / (m n).
        source_sigma_m, target_sigma_m : (m,) and (n,), optional
            Standard deviations [m] of the components, > 0.
        is_density : bool
            True divides by N_ij = 2 pi (sigma_i^2 + sigma_j^2), as eq. 3 demands; False takes N =
            1, so that -1 is the value of one source point that lies exactly on a target that is a
            single point.

        Raises
        ------
        InvalidInputError
            On a wrong shape, a value that is not finite, or a weight or sigma out of range.
        """
        source, target = _points("source", source), _points("target", target)
        sigma_x = _positive("source_sigma_m", source_sigma_m, len(source), sigma_m)
        sigma_y = _positive("target_sigma_m", target_sigma_m, len(target), sigma_m)
        weight_x = _normalised("source_weights", source_weights, len(source))
        weight_y = _normalised("target_weights", target_weights, len(target))
        variances = sigma_x[:, None] ** 2 + sigma_y[None, :] ** 2
        weights = weight_x[:, None] * weight_y[None, :]
        if is_density:
            weights = weights / (2.0 * math.pi * variances)
        return cls(source, target, weights, variances)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """K boxes of solutions: theta in theta_c +- beta, t in a square of half side h around t_c.

    ``theta`` (K,) [rad] and ``t`` (K, 2) [m] are the centres; all boxes share ``beta_rad`` and
    ``half_side_m``.
    """

    theta: FloatArray
    t: FloatArray
    beta_rad: float
    half_side_m: float

    @property
    def rho_m(self) -> float:
        """Radius [m] of the circle around the translation square: its half diagonal."""
        return math.sqrt(2.0) * self.half_side_m

    def split(self) -> Boxes:
        """Halve every side: 2^3 = 8 children for each box, in order of their parents."""
        beta, half = self.beta_rad / 2.0, self.half_side_m / 2.0
        signs = np.array(
            [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], dtype=float
        )
        theta = self.theta[:, None] + beta * signs[None, :, 0]
        t = self.t[:, None, :] + half * signs[None, :, 1:]
        return Boxes(theta.reshape(-1), t.reshape(-1, 2), beta, half)

    def centre(self, index: int) -> SE2:
        """The pose delta(B) at the centre of a box."""
        return SE2(float(self.t[index, 0]), float(self.t[index, 1]), float(self.theta[index]))


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceResult:
    """What Algorithm 3 found; the paper's sign, so lower <= min E <= upper <= 0."""

    T_target_source: SE2
    lower_bound: float
    upper_bound: float
    is_converged: bool
    num_iterations: int
    num_boxes: int
    history: FloatArray  # (num_iterations + 1, 2): lower and upper bound after each iteration

    @property
    def gap(self) -> float:
        """Absolute gap, UB - LB."""
        return self.upper_bound - self.lower_bound


def residuals(pair: MixturePair, theta: ArrayLike, t: ArrayLike) -> FloatArray:
    """e_ij = ||R(theta) X_i + t - Y_j|| [m], (K, m, n), at K poses: theta (K,), t (K, 2)."""
    moved = _rotated(pair.source, theta) + np.reshape(t, (-1, 1, 2))
    return np.linalg.norm(moved[:, :, None, :] - pair.target[None, None, :, :], axis=3)


def objective(pair: MixturePair, theta: ArrayLike, t: ArrayLike) -> FloatArray:
    """E at K poses, shape (K,): eq. 3 without the terms that no motion changes."""
    return -_sum_of_gaussians(pair, residuals(pair, theta, t))


def upper_bound(pair: MixturePair, boxes: Boxes) -> FloatArray:
    """R_U(B), eq. 6: the minimum over a box is at most the value at its centre; shape (K,)."""
    return objective(pair, boxes.theta, boxes.t)


def lower_bound(pair: MixturePair, boxes: Boxes) -> FloatArray:
    """R_L(B), eq. 7: every residual replaced by its own lower bound over the box; shape (K,)."""
    return -_sum_of_gaussians(pair, residual_lower_bound(pair, boxes))


def residual_lower_bound(pair: MixturePair, boxes: Boxes) -> FloatArray:
    """e_L of eqs. 4 and 5 as corrected [m], (K, m, n): at most every residual in the box.

    Seen from the translation centre, ``R(theta) X_i`` runs along an arc of half angle beta around
    the origin, and the rest of the translation moves it by at most rho. The arc comes closest to
    ``Y_j - t_c`` where the angle between the two is least: on the ray through it when the arc
    reaches that far (alpha <= beta), else at one end.
    """
    Y = pair.target[None, :, :] - boxes.t[:, None, :]  # (K, n, 2)
    X_c = _rotated(pair.source, boxes.theta)  # (K, m, 2)
    bearing_x = np.arctan2(X_c[..., 1], X_c[..., 0])[:, :, None]
    bearing_y = np.arctan2(Y[..., 1], Y[..., 0])[:, None, :]
    alpha = np.abs(wrap_angle(bearing_y - bearing_x))
    distance = _distance_to_arc(pair, boxes, Y, alpha)
    return np.maximum(distance - boxes.rho_m, 0.0)


def printed_residual_bound(pair: MixturePair, boxes: Boxes) -> FloatArray:
    """Eqs. 4 and 5 by the letter: *not* a bound, kept to show why they need correcting.

    ``Y_j`` is not shifted by the translation centre; the rest is as in `residual_lower_bound`.
    """
    Y = np.broadcast_to(pair.target[None, :, :], (len(boxes.theta), *pair.target.shape))
    X_c = _rotated(pair.source, boxes.theta)
    bearing_x = np.arctan2(X_c[..., 1], X_c[..., 0])[:, :, None]
    bearing_y = np.arctan2(Y[..., 1], Y[..., 0])[:, None, :]
    alpha = np.abs(wrap_angle(bearing_y - bearing_x))
    return np.maximum(_distance_to_arc(pair, boxes, Y, alpha) - boxes.rho_m, 0.0)


def initial_box(source: ArrayLike, target: ArrayLike) -> Boxes:
    """B_0: every rotation, and every translation that can lay a source point on a target point."""
    source, target = _points("source", source), _points("target", target)
    low, high = target.min(axis=0), target.max(axis=0)
    reach = float(np.linalg.norm(source, axis=1).max())
    half = float((high - low).max()) / 2.0 + reach
    return Boxes(np.zeros(1), ((low + high) / 2.0)[None, :], math.pi, max(half, 1e-9))


def register_reference(
    pair: MixturePair,
    *,
    box: Boxes | None = None,
    gap: float = 0.01,
    is_gap_relative: bool = False,
    max_iterations: int = 100_000,
    on_iteration: Callable[[int, float, float], bool | None] | None = None,
) -> ReferenceResult:
    """Algorithm 3: best-first branch and bound over (theta, t) with an eight-way split.

    Parameters
    ----------
    pair : MixturePair
        The mixtures.
    box : Boxes, optional
        B_0, one box, in the coordinates of `pair`; the paper's protocol has t in [-1, 1]^2.
        Without it the sets are first centred on their bounding boxes (line 1, "normalize the mean
        values") and `initial_box` is searched.
    gap : float
        epsilon: stop once UB - LB is at most this (once divided by -UB if `is_gap_relative`). The
        paper says 0.01.
    max_iterations : int
        Stop here too; the result then says that it did not converge, and its bounds hold all the
        same.
    on_iteration : callable, optional
        Called with the iteration and both bounds; stops the search by returning True.
    """
    if box is None:
        centred, T_centre_source, T_target_centre = _centred(pair)
        found = register_reference(
            centred,
            box=initial_box(centred.source, centred.target),
            gap=gap,
            is_gap_relative=is_gap_relative,
            max_iterations=max_iterations,
            on_iteration=on_iteration,
        )
        T_target_source = T_target_centre @ found.T_target_source @ T_centre_source
        return replace(found, T_target_source=T_target_source)
    upper = float(upper_bound(pair, box)[0])  # line 2
    best = box.centre(0)
    # The list xi, ordered by R_L; the counter decides ties, so that equal inputs take equal paths.
    xi: list[tuple[float, int, float, float, float, float, float]] = []
    num_boxes = 1
    first = float(lower_bound(pair, box)[0])
    heapq.heappush(xi, (first, 0, *_heap_entry(box, 0)))
    history = [(first, upper)]
    is_converged = False
    while xi:  # line 3, a loop
        lower = xi[0][0]
        is_converged = upper - lower <= gap * (-upper if is_gap_relative else 1.0)
        if is_converged or len(history) > max_iterations:
            break
        parent = heapq.heappop(xi)  # line 4: the box of least R_L ...
        children = _box_of_entry(parent).split()  # ... in eight; it leaves xi (line 5)
        values, bounds = upper_bound(pair, children), lower_bound(pair, children)
        # A child lies inside its parent, whose bound holds for it too.
        bounds = np.maximum(bounds, parent[0])
        k = int(np.argmin(values))
        if values[k] < upper:  # lines 7 and 8
            upper, best = float(values[k]), children.centre(k)
        for i in np.flatnonzero(bounds <= upper):  # line 11: others cannot hold the optimum
            heapq.heappush(
                xi, (float(bounds[i]), num_boxes + int(i), *_heap_entry(children, int(i)))
            )
        num_boxes += len(bounds)
        history.append((min(xi[0][0], upper) if xi else upper, upper))  # line 6
        if on_iteration is not None and on_iteration(len(history) - 1, *history[-1]):
            break
    lower, upper = history[-1]
    return ReferenceResult(
        best, lower, upper, is_converged or not xi, len(history) - 1, num_boxes, np.array(history)
    )


def _centred(pair: MixturePair) -> tuple[MixturePair, SE2, SE2]:
    """The pair with both sets centred on their bounding boxes, and the motions there and back."""
    c_x, c_y = ((p.min(axis=0) + p.max(axis=0)) / 2.0 for p in (pair.source, pair.target))
    centred = replace(pair, source=pair.source - c_x, target=pair.target - c_y)
    return centred, SE2(-float(c_x[0]), -float(c_x[1])), SE2(float(c_y[0]), float(c_y[1]))


def _distance_to_arc(
    pair: MixturePair, boxes: Boxes, Y: FloatArray, alpha: FloatArray
) -> FloatArray:
    """Least of ||Y_j - R(theta) X_i|| over theta_c +- beta, (K, m, n), for Y (K, n, 2)."""
    length_x = np.linalg.norm(pair.source, axis=1)[None, :, None]
    length_y = np.linalg.norm(Y, axis=2)[:, None, :]
    ends = [
        np.linalg.norm(
            _rotated(pair.source, boxes.theta + side)[:, :, None, :] - Y[:, None, :, :], axis=3
        )
        for side in (-boxes.beta_rad, boxes.beta_rad)  # l- and l+, eq. 5
    ]
    return np.where(alpha <= boxes.beta_rad, np.abs(length_y - length_x), np.minimum(*ends))


def _sum_of_gaussians(pair: MixturePair, distances: FloatArray) -> FloatArray:
    return np.sum(pair.weights * np.exp(-(distances**2) / (2.0 * pair.variances)), axis=(1, 2))


def _rotated(points: FloatArray, theta: ArrayLike) -> FloatArray:
    """R(theta) x for all points and K angles, shape (K, N, 2)."""
    theta = np.reshape(np.asarray(theta, dtype=np.float64), (-1, 1))
    cos, sin = np.cos(theta), np.sin(theta)
    x, y = points[None, :, 0], points[None, :, 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=2)


def _heap_entry(boxes: Boxes, i: int) -> tuple[float, float, float, float, float]:
    tx, ty = boxes.t[i]
    return float(boxes.theta[i]), float(tx), float(ty), boxes.beta_rad, boxes.half_side_m


def _box_of_entry(entry: tuple[float, int, float, float, float, float, float]) -> Boxes:
    _, _, theta, tx, ty, beta, half = entry
    return Boxes(np.array([theta]), np.array([[tx, ty]]), beta, half)


def _points(name: str, values: ArrayLike) -> FloatArray:
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
        raise InvalidInputError(f"{name} has shape {points.shape}, expected (N > 0, 2)")
    if not np.isfinite(points).all():
        raise InvalidInputError(f"{name} holds NaN or infinite values, expected finite metres")
    return points


def _positive(name: str, values: ArrayLike | None, length: int, default: float) -> FloatArray:
    array = np.full(length, default) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (length,):
        raise InvalidInputError(f"{name} has shape {array.shape}, expected ({length},)")
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise InvalidInputError(f"{name} holds {array.min()}, expected finite values > 0")
    return array


def _normalised(name: str, values: ArrayLike | None, length: int) -> FloatArray:
    array = np.ones(length) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (length,):
        raise InvalidInputError(f"{name} has shape {array.shape}, expected ({length},)")
    if not (np.isfinite(array).all() and (array >= 0).all() and array.sum() > 0):
        raise InvalidInputError(f"{name} is {array}, expected finite values >= 0 with a sum > 0")
    return array / array.sum()
