"""Navigation against the sonar's own motion: which reading of both agrees best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample

__all__ = [
    "SURE",
    "TurnFit",
    "VelocityFit",
    "at_times",
    "believed",
    "confidence_of",
    "confidence_of_lead",
    "fit_current",
    "fit_turns",
    "fit_velocity",
    "turned",
    "turns_of",
]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_YAW_FLOOR_RAD = 0.003
_FLOOR_M = 0.01
_STEP_S = 0.02
_MAX_GAP_S = 1.5
_ITERATIONS = 12
SURE = 0.99
"""How sure a cause must be, to be mended unasked."""
_MAX_TURN_COST = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class TurnFit:
    """Turns by navigation against those by echoes: ``cost`` (M,) of each ping motion.

    ``repeats`` is how many motions tell of the same moment.
    """

    sign: int
    delay_s: float
    cost: FloatArray
    repeats: float = 1.0


class Compared(NamedTuple):
    """Motions (N,) that a velocity was fitted to, in base_link at their beginning.

    ``measured`` [m] is by the velocity, ``seen`` [m] by echoes, with its information ``weight``
    (N, 2, 2); ``drifted`` [s] is the way of 1 m/s along the world's x.
    """

    measured: ComplexArray
    drifted: ComplexArray
    seen: ComplexArray
    weight: FloatArray


class Current(NamedTuple):
    """A steady velocity along the world's axes that explains more, beside a factor.

    ``lead`` is by how much less the motions cost with it.
    """

    m_s: float
    sigma_m_s: float
    lead: float


@dataclass(frozen=True, slots=True, eq=False)
class VelocityFit:
    """``factor`` turns and scales the measured velocity to the one by echoes.

    With ``is_mirrored`` the velocity's sideways part changes its sign first. ``factor_sigma`` is
    the factor's standard deviation, of its real and of its imaginary part; ``cost`` (M,) that of
    each ping motion.
    """

    factor: complex
    factor_sigma: float
    is_mirrored: bool
    cost: FloatArray
    repeats: float = 1.0
    compared: Compared | None = None

    @property
    def yaw_rad(self) -> float:
        """By how much it turns."""
        return math.atan2(self.factor.imag, self.factor.real)

    @property
    def scale(self) -> float:
        """By how much it scales."""
        return abs(self.factor)


def turned(times_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
    """Integral (K,) of rates (K,) over their times."""
    steps = 0.5 * (rate_rad_s[1:] + rate_rad_s[:-1]) * np.diff(times_s)
    return np.concatenate([[0.0], np.cumsum(steps)])


def at_times(times_s: FloatArray, known_s: FloatArray, known: FloatArray) -> FloatArray:
    """Interpolate; NaN beyond the ends and where what is known has a gap."""
    if len(known_s) < 2:
        return np.full(len(times_s), np.nan)
    right = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
    gap = known_s[right] - known_s[right - 1]
    outside = (times_s < known_s[0]) | (times_s > known_s[-1]) | (gap > _MAX_GAP_S)
    return np.where(outside, np.nan, np.interp(times_s, known_s, known))


def turns_of(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray, delay_s: float
) -> FloatArray:
    """By how much a yaw (K,) turns in each motion (M,); NaN where it is not known."""
    begin = at_times(motions.begin_s - delay_s, imu_s, yaw_rad)
    return at_times(motions.end_s - delay_s, imu_s, yaw_rad) - begin


def _robust(squares: FloatArray) -> FloatArray:
    """Cost of squared normal deviates that outliers raise slowly; 3 where nothing is known."""
    return np.asarray(np.where(np.isnan(squares), 3.0, np.log1p(squares / 4.0)))


def _turn_cost(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray, sign: int, delay_s: float
) -> FloatArray:
    turns = sign * turns_of(motions, imu_s, yaw_rad, delay_s)
    error = np.mod(motions.motion[:, 2] - turns + math.pi, 2.0 * math.pi) - math.pi
    return _robust(np.square(error / _YAW_FLOOR_RAD))


def fit_turns(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray, max_delay_s: float = 2.3
) -> list[TurnFit]:
    """How a yaw (K,), not wrapped, turns with the echoes, by sign and delay; the best fit first.

    The delay is how much later than the yaw's the sonar's stamps are. The first of the list is
    the best of all, then come the best of the other sign and the best without delay.
    """
    delays = np.arange(-max_delay_s, max_delay_s + 1e-9, 0.05)
    fits = []
    for sign in (1, -1):
        costs = [_turn_cost(motions, imu_s, yaw_rad, sign, d) for d in delays]
        best = int(np.argmin([c.sum() for c in costs]))
        around = delays[best] + np.arange(-0.04, 0.041, 0.01)
        fine = [_turn_cost(motions, imu_s, yaw_rad, sign, d) for d in around]
        chosen = int(np.argmin([c.sum() for c in fine]))
        fits.append(TurnFit(sign, float(around[chosen]), fine[chosen], motions.repeats))
    fits.sort(key=lambda fit: float(fit.cost.sum()))
    still = _turn_cost(motions, imu_s, yaw_rad, fits[0].sign, 0.0)
    return [*fits, TurnFit(fits[0].sign, 0.0, still, motions.repeats)]


def believed(fits: list[TurnFit]) -> list[TurnFit] | None:
    """Fits of `fit_turns` where the best is close, and surely better than the other sign's."""
    best, other = fits[0], fits[1]
    if not len(best.cost) or float(np.mean(best.cost)) > _MAX_TURN_COST:
        return None
    return fits if confidence_of(best, other) > SURE else None


def fit_velocity(
    motions: PingMotions,
    navigation: NavigationSample,
    yaw_rad: FloatArray,
    delay_s: float,
    *,
    sonar: complex,
    sonar_yaw_rad: float,
    is_sonar_mirrored: bool = False,
    is_velocity_mirrored: bool = False,
    is_velocity_in_world: bool = False,
    velocity_delay_s: float = 0.0,
) -> VelocityFit | None:
    """Turn and scale of the velocity that explain how the echoes move; None where too few do.

    Parameters
    ----------
    yaw_rad : (K,) of base_link at ``navigation.imu_s``, not wrapped.
    delay_s : how much later than navigation's the sonar's stamps are.
    sonar : the sonar's place in base_link, x + iy [m]; `sonar_yaw_rad` its direction.
    is_sonar_mirrored : read the echoes with port and starboard exchanged.
    is_velocity_mirrored : read the velocity with its sideways axis the other way.
    is_velocity_in_world : read the velocity along axes that do not turn with the vehicle.
    velocity_delay_s : how much later than the IMU's the velocity's stamps are.
    """
    grid = np.arange(navigation.imu_s[0], navigation.imu_s[-1], _STEP_S)
    yaw = at_times(grid, navigation.imu_s, yaw_rad)
    stamped = grid + velocity_delay_s
    velocity = at_times(
        stamped, navigation.velocity_s, navigation.velocity_m_s[:, 0]
    ) + 1j * at_times(stamped, navigation.velocity_s, navigation.velocity_m_s[:, 1])
    if is_velocity_mirrored:
        velocity = np.conj(velocity)
    if is_velocity_in_world:
        velocity = velocity * np.exp(-1j * yaw)
    lever = sonar - complex(*navigation.velocity_lever_m)

    begin = np.searchsorted(grid, motions.begin_s - delay_s)
    end = np.searchsorted(grid, motions.end_s - delay_s)
    inside = (begin > 0) & (end < len(grid))
    begin, end = np.where(inside, begin, 0), np.where(inside, end, 0)
    moved = _path(velocity, yaw, begin, end)
    turn = yaw[end] - yaw[begin]
    predicted = np.exp(-1j * yaw[begin]) * moved

    seen = motions.motion[:, 0] + 1j * motions.motion[:, 1]
    if is_sonar_mirrored:
        seen = np.conj(seen)
    # The echoes' motion is the sonar's; that of the velocity's place is less the lever's swing.
    seen = np.exp(1j * sonar_yaw_rad) * seen - (np.exp(1j * turn) - 1.0) * lever
    usable = inside & np.isfinite(predicted) & np.isfinite(seen)
    weight = _weights(motions, sonar_yaw_rad, is_sonar_mirrored)
    if usable.sum() < 8:
        return None
    drifted = np.exp(-1j * yaw[begin]) * (end - begin) * _STEP_S
    compared = Compared(predicted[usable], drifted[usable], seen[usable], weight[usable])
    factor, sigma, cost = _solve([compared.measured], compared.seen, compared.weight)[0]
    costs = np.full(len(motions), np.nan)
    costs[usable] = cost
    sigma *= math.sqrt(motions.repeats)
    return VelocityFit(factor, sigma, is_velocity_mirrored, costs, motions.repeats, compared)


def fit_current(fit: VelocityFit) -> Current:
    """What a current explains of the motions that `fit_velocity` compared."""
    assert fit.compared is not None
    measured, drifted, seen, weight = fit.compared
    current, sigma, cost = _solve([measured, drifted], seen, weight)[1]
    before = fit.cost[np.isfinite(fit.cost)]
    return Current(abs(current), sigma * math.sqrt(fit.repeats), float(before.sum() - cost.sum()))


def _path(
    velocity: ComplexArray, yaw: FloatArray, begin: NDArray[np.int64], end: NDArray[np.int64]
) -> ComplexArray:
    """Way (M,) from one sample to another; NaN where there is a gap between."""
    steps = np.exp(1j * yaw) * velocity * _STEP_S
    is_bad = ~np.isfinite(steps)
    path, num_bad = np.cumsum(np.where(is_bad, 0.0, steps)), np.cumsum(is_bad)
    return np.asarray(np.where(num_bad[end] > num_bad[begin], np.nan, path[end] - path[begin]))


def _weights(motions: PingMotions, sonar_yaw_rad: float, is_mirrored: bool) -> FloatArray:
    """Information (M, 2, 2) of the translations, in base_link's axes."""
    covariance = motions.covariance()[:, :2, :2].copy()
    if is_mirrored:
        covariance[:, 0, 1] *= -1.0
        covariance[:, 1, 0] *= -1.0
    cos, sin = math.cos(sonar_yaw_rad), math.sin(sonar_yaw_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    # The matcher's own figures are several times too careful for well-seen directions.
    scaled = turn @ covariance @ turn.T * 0.01
    return np.asarray(np.linalg.inv(scaled + _FLOOR_M**2 * np.eye(2)))


def _solve(
    known: Sequence[ComplexArray], seen: ComplexArray, weight: FloatArray
) -> list[tuple[complex, float, FloatArray]]:
    """Robust least squares of ``seen = sum of factor * known``: each factor, its sigma, costs."""
    columns = []
    for own in known:
        x, y = own.real, own.imag
        columns += [np.stack([x, y], axis=1), np.stack([-y, x], axis=1)]
    design = np.stack(columns, axis=2)
    target = np.stack([seen.real, seen.imag], axis=1)
    weak = 1e-9 * np.eye(len(columns))
    trust = np.ones(len(seen))
    factor = np.zeros(len(columns))
    for _ in range(_ITERATIONS):
        normal = np.einsum("m,mki,mkl,mlj->ij", trust, design, weight, design)
        side = np.einsum("m,mki,mkl,ml->i", trust, design, weight, target)
        factor = np.linalg.solve(normal + weak, side)
        error = target - design @ factor
        squares = np.einsum("mk,mkl,ml->m", error, weight, error)
        trust = 1.0 / (1.0 + squares / 4.0)
    # The residuals say how good the figures are that went in.
    spread = max(1.0, float(np.median(squares)) / 1.39)
    variance = spread * np.diag(np.linalg.inv(normal + weak))
    cost = _robust(squares)
    return [
        (complex(*factor[i : i + 2]), math.sqrt(float(variance[i : i + 2].sum()) / 2.0), cost)
        for i in range(0, len(columns), 2)
    ]


def confidence_of[FitT: (TurnFit, VelocityFit)](
    better: FitT, worse: FitT, num_tried: int = 1
) -> float:
    """How sure it is that the lower costs (M,) are no chance, 0.5 to 1.

    A cost is a negative log-likelihood; neighbouring motions err together, so two count as one,
    and those of the same moment as half of one. Of `num_tried` that had the same chance to be the
    better one, below 0.5 too.
    """
    both = np.isfinite(better.cost) & np.isfinite(worse.cost)
    lead = float((worse.cost[both] - better.cost[both]).sum())
    return confidence_of_lead(lead, better.repeats, num_tried)


def confidence_of_lead(lead: float, repeats: float, num_tried: int = 1) -> float:
    """How sure a total cost is lower by `lead` not by chance, see `confidence_of`."""
    return float(scipy.special.expit(lead / (2.0 * repeats) - math.log(num_tried)))
