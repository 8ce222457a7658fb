"""Dead reckoning: an extended Kalman filter that takes messages in any order."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.navigation.config import NavigationConfig
from uw_dslam_ros2.core.navigation.doubt import are_alike, doubted
from uw_dslam_ros2.core.navigation.kernels import NUM_STATES, gated_update, predict
from uw_dslam_ros2.core.navigation.measurements import (
    Clone,
    Event,
    Fix,
    Velocity,
    Yaw,
    YawRate,
    relative_pose,
)
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["FilterState", "NavigationFilter"]

FloatArray = NDArray[np.float64]
# At one stamp events are applied in this order, whatever order they came in.
_ORDER = {YawRate: 0, Yaw: 1, Velocity: 2, Fix: 3, Clone: 4}
_ROLES: dict[str, tuple[type, ...]] = {"velocity": (Velocity,), "imu": (Yaw, YawRate)}
_WAIT_FOR_YAW_NS = 1_000_000_000
_UNKNOWN_HEADING_RAD = math.pi
_UNSURE_M_S = 0.3
"""A velocity known no better passes nearly everything: then two measurements have to agree."""

_Key = tuple[int, int, tuple[float, ...]]
"""Stamp, order of the kind, content: equal only for equal messages."""


@dataclass(slots=True, eq=False)
class _Record:
    """An event and the filter after it."""

    key: _Key
    event: Event
    state: FloatArray
    covariance: FloatArray
    refused_since_ns: dict[type, int]
    said: tuple[int, FloatArray] | None = None
    """When a velocity (2,) [m/s] along base_link's axes was measured last, used or not."""


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """What a filter knows at one moment, so that another goes on from there."""

    stamp_ns: int
    mean: FloatArray
    """(S,): pose, velocity, sensor errors, and the pose of the clone."""
    covariance: FloatArray
    """(S, S)."""
    zero_rad: float | None
    """Yaw of the odom frame's x axis, where the frame was begun before there was a yaw."""


class NavigationFilter:
    """Pose, velocity and sensor errors from velocity (DVL or commands), yaw and yaw rate.

    Messages may come late and out of order, up to `NavigationConfig.horizon_s`: the filter winds
    back and applies them where they belong, so the result does not depend on the order of arrival.
    The odom frame begins at the first message's position with the first yaw's direction (0 if
    there is none within a second).
    """

    def __init__(self, config: NavigationConfig = NavigationConfig()) -> None:  # noqa: B008 (frozen)
        self._config = config
        self._noise = np.array([
            config.velocity_walk_m_s, config.turn_walk_rad_s, config.gyro_bias_walk_rad_s,
            config.heading_offset_sigma_rad, config.heading_offset_time_s,
            config.current_sigma_m_s, config.current_time_s,
        ])  # fmt: skip
        self._early: list[tuple[_Key, Event]] | None = []
        self._records: list[_Record] = []
        self._memory_s = config.horizon_s
        self._is_blind = False  # begun without a yaw
        self._zero_rad: float | None = None
        self.num_late = 0
        self.num_invalid = 0
        self.num_outliers = 0
        self._judged: Counter[tuple[type, bool]] = Counter()

    @property
    def is_started(self) -> bool:
        """Whether there is a pose yet."""
        return bool(self._records)

    @property
    def stamp_ns(self) -> int | None:
        """Time of the newest event that has been applied; None before the start."""
        return self._records[-1].key[0] if self._records else None

    @property
    def oldest_ns(self) -> int | None:
        """From when on poses are known; None before the start."""
        return self._records[0].key[0] if self._records else None

    def state(self) -> FilterState:
        """All that is known now; raises `InvalidInputError` before the start."""
        if not self._records:
            raise InvalidInputError("the filter has no state yet, expected measurements first")
        newest = self._records[-1]
        return FilterState(newest.key[0], newest.state, newest.covariance, self._zero_rad)

    def resume(self, state: FilterState) -> None:
        """Go on from a state in the place of a start; what is earlier counts as late."""
        if state.mean.shape != (NUM_STATES,) or state.covariance.shape != (NUM_STATES,) * 2:
            raise InvalidInputError(
                f"the filter's state has shape {state.mean.shape}, expected ({NUM_STATES},)"
            )
        key = state.stamp_ns, max(_ORDER.values()), ()
        self._records = [_Record(key, Clone(), state.mean, state.covariance, {})]
        self._early, self._zero_rad = None, state.zero_rad
        self._is_blind = state.zero_rad is not None

    def remember(self, span_s: float) -> None:
        """Know poses, and take late messages, for so long from now on; at least the horizon."""
        self._memory_s = max(self._config.horizon_s, span_s)

    def add_yaw(self, stamp_ns: int, yaw_rad: float, sigma_rad: float | None = None) -> None:
        """Yaw of base_link [rad], counter-clockwise.

        Anything not finite is counted and dropped.
        """
        sigma = self._config.yaw_sigma_rad if sigma_rad is None else sigma_rad
        if self._is_valid(yaw_rad, sigma) and sigma > 0.0:
            yaw_rad = float(yaw_rad) - self._yaw_zero_rad(stamp_ns, float(yaw_rad))
            self._add(stamp_ns, Yaw(yaw_rad, float(sigma)), (yaw_rad,))

    def _yaw_zero_rad(self, stamp_ns: int, yaw_rad: float) -> float:
        """Yaw of the odom frame's x axis, where that was begun before there was a yaw.

        Such a frame points anywhere. That is no error of the compass, which fades with time.
        """
        if not self._is_blind:
            return 0.0
        if self._zero_rad is None:
            self._zero_rad = yaw_rad - self.pose_at(stamp_ns)[0].yaw
        return self._zero_rad

    def add_yaw_rate(
        self, stamp_ns: int, yaw_rate_rad_s: float, sigma_rad_s: float | None = None
    ) -> None:
        """Yaw rate [rad/s], counter-clockwise."""
        sigma = self._config.yaw_rate_sigma_rad_s if sigma_rad_s is None else sigma_rad_s
        if self._is_valid(yaw_rate_rad_s, sigma) and sigma > 0.0:
            self._add(
                stamp_ns, YawRate(float(yaw_rate_rad_s), float(sigma)), (float(yaw_rate_rad_s),)
            )

    def add_velocity(
        self,
        stamp_ns: int,
        velocity_m_s: ArrayLike,
        covariance: ArrayLike | None = None,
        T_base_sensor: SE2 = SE2(),
    ) -> None:
        """Velocity (2,) [m/s] along the instrument's axes (x forward, y left).

        A velocity that is not finite (no bottom lock) is counted and dropped; so is a covariance
        that is none.
        """
        velocity = np.asarray(velocity_m_s, dtype=np.float64)
        if velocity.shape != (2,):
            raise InvalidInputError(f"velocity has shape {velocity.shape}, expected (2,)")
        noise = np.eye(2) * self._config.velocity_sigma_m_s**2
        if covariance is not None:
            noise = np.asarray(covariance, dtype=np.float64)
            if noise.shape != (2, 2):
                raise InvalidInputError(
                    f"velocity covariance has shape {noise.shape}, expected (2, 2)"
                )
        if not self._is_valid(*velocity, *noise.ravel()):
            return
        noise = 0.5 * (noise + noise.T)
        if np.linalg.eigvalsh(noise)[0] <= 0.0:
            noise = np.eye(2) * self._config.velocity_sigma_m_s**2
        self._add(stamp_ns, Velocity(velocity, noise, T_base_sensor), tuple(velocity.tolist()))

    def add_fix(self, stamp_ns: int, T_clone_base: SE2, information: FloatArray) -> None:
        """Pose relative to the clone, with information (3, 3) that may be singular."""
        self._add(stamp_ns, Fix(T_clone_base, information), (T_clone_base.x, T_clone_base.y))

    def clone(self, stamp_ns: int) -> None:
        """Make the pose at `stamp_ns` the reference of relative poses from then on.

        Raises `InvalidInputError` for a moment before `oldest_ns`.
        """
        oldest_ns = self.oldest_ns
        if self._early is None and oldest_ns is not None and stamp_ns < oldest_ns:
            raise InvalidInputError(
                f"the pose at {stamp_ns} ns is forgotten, expected {oldest_ns} or later"
            )
        self._add(stamp_ns, Clone(), ())

    def pose_at(self, stamp_ns: int) -> tuple[SE2, FloatArray]:
        """``T_odom_base`` and covariance (3, 3), predicted from what was measured until then."""
        state, covariance = self._at(stamp_ns)
        return SE2.from_array(state[:3]), covariance[:3, :3].copy()

    def relative_at(self, stamp_ns: int) -> tuple[SE2, FloatArray]:
        """``T_clone_base`` and its covariance (3, 3), in the clone's frame."""
        state, covariance = self._at(stamp_ns)
        relative, jac = relative_pose(state)
        return SE2.from_array(relative), jac @ covariance @ jac.T

    def velocity_at(self, stamp_ns: int) -> tuple[FloatArray, float]:
        """Body velocity (2,) [m/s] over ground and yaw rate [rad/s]."""
        state, _ = self._at(stamp_ns)
        cos, sin = math.cos(state[2]), math.sin(state[2])
        current = np.array([cos * state[9] + sin * state[10], -sin * state[9] + cos * state[10]])
        return (1.0 + state[7]) * state[3:5] + current, float(state[5])

    def velocity_covariance_at(self, stamp_ns: int) -> FloatArray:
        """Covariance (3, 3) of body velocity [m/s], forward and left, and yaw rate [rad/s]."""
        _, covariance = self._at(stamp_ns)
        return covariance[3:6, 3:6].copy()

    def sensor_errors(self) -> dict[str, float]:
        """What the filter believes of its sensors now."""
        if not self._records:
            return {}
        state = self._records[-1].state
        names = (
            "gyro_bias_rad_s",
            "velocity_scale",
            "heading_offset_rad",
            "current_x_m_s",
            "current_y_m_s",
        )
        return {name: float(value) for name, value in zip(names, state[6:11], strict=True)}

    def counts(self) -> dict[str, int]:
        """How often measurements were used and refused, by their sensor.

        What is applied again, because an earlier message came late, counts again.
        """
        result = {}
        for role, kinds in _ROLES.items():
            for name, is_used in (("used", True), ("outliers", False)):
                total = sum(self._judged[kind, is_used] for kind in kinds)
                result[f"num_{role}_{name}"] = total
        return result

    def _is_valid(self, *values: float) -> bool:
        if all(math.isfinite(value) for value in values):
            return True
        self.num_invalid += 1
        return False

    def _add(self, stamp_ns: int, event: Event, content: tuple[float, ...]) -> None:
        key = (int(stamp_ns), _ORDER[type(event)], content)
        if self._early is not None:
            self._add_early(key, event)
            return
        if key < self._records[0].key:
            self.num_late += 1
            return
        position = bisect.bisect_right(self._records, key, key=lambda record: record.key)
        replayed = [record.event for record in self._records[position:]]
        keys = [record.key for record in self._records[position:]]
        del self._records[position:]
        self._apply(key, event)
        for old_key, old_event in zip(keys, replayed, strict=True):
            self._apply(old_key, old_event)
        self._forget()

    def _add_early(self, key: _Key, event: Event) -> None:
        """Near the start everything is kept, since a late message may change how it began."""
        early = self._early
        assert early is not None
        bisect.insort(early, (key, event), key=lambda item: item[0])
        span_ns = early[-1][0][0] - early[0][0][0]
        if self._records and early[-1][0] == key and early[-1][1] is event:
            self._apply(key, event)
        elif (
            self._records
            or span_ns > _WAIT_FOR_YAW_NS
            or any(isinstance(e, Yaw) for _, e in early)
        ):
            self._begin()
        if self._records and span_ns > self._config.horizon_s * 1e9:
            self._early = None

    def _begin(self) -> None:
        config = self._config
        waiting = self._early or []
        first_yaw = next((event for _, event in waiting if isinstance(event, Yaw)), None)
        if self._is_blind:
            first_yaw = None  # poses were given in the frame that was begun without it
        self._is_blind = first_yaw is None
        state = np.zeros(NUM_STATES)
        state[2] = state[13] = first_yaw.yaw_rad if first_yaw is not None else 0.0
        sigma = np.zeros(NUM_STATES)
        sigma[3:5] = 1.0 + config.velocity_walk_m_s
        sigma[5] = 1.0
        sigma[6] = config.gyro_bias_sigma_rad_s
        sigma[7] = config.velocity_scale_sigma
        sigma[8] = (
            config.heading_offset_sigma_rad if first_yaw is not None else _UNKNOWN_HEADING_RAD
        )
        sigma[9:11] = config.current_sigma_m_s
        covariance = np.diag(sigma**2)
        if (
            first_yaw is not None
        ):  # the frame's direction is the first yaw, its error is the frame's, not the pose's
            covariance[2, 2] = first_yaw.sigma_rad**2 + config.heading_offset_sigma_rad**2
            covariance[2, 8] = covariance[8, 2] = -(config.heading_offset_sigma_rad**2)
            covariance[13, 13] = covariance[2, 2]
            covariance[2, 13] = covariance[13, 2] = covariance[2, 2]
            covariance[8, 13] = covariance[13, 8] = covariance[2, 8]
        start_key = (waiting[0][0][0], -1, ())
        self._records = [_Record(start_key, Clone(), state, covariance, {})]
        for key, event in waiting:
            if event is not first_yaw:
                self._apply(key, event)

    def _apply(self, key: _Key, event: Event) -> None:
        before = self._records[-1]
        state, covariance = self._predicted(before, key[0])
        refused = before.refused_since_ns
        if isinstance(event, Clone):
            jac = np.eye(NUM_STATES)
            jac[11:14] = 0.0
            jac[11:14, 0:3] = np.eye(3)
            state, covariance = jac @ state, jac @ covariance @ jac.T
        else:
            state, covariance, refused = self._measured(key[0], event, state, covariance, before)
        said = before.said
        if isinstance(event, Velocity):
            said = key[0], event.T_base_sensor.rotation() @ event.velocity_m_s
        self._records.append(_Record(key, event, state, covariance, refused, said))

    def _measured(
        self,
        stamp_ns: int,
        event: Yaw | YawRate | Velocity | Fix,
        state: FloatArray,
        covariance: FloatArray,
        before: _Record,
    ) -> tuple[FloatArray, FloatArray, dict[type, int]]:
        innovation, jac, noise = event.model(state)
        refused = before.refused_since_ns
        if len(innovation) == 0:
            return state, covariance, refused
        kind = type(event)
        gate = (self._config.gate_sigma**2) * (1.0 + 0.5 * (len(innovation) - 1))
        walk_m_s = self._config.velocity_walk_m_s
        agrees = isinstance(event, Velocity) and are_alike(
            before.said, stamp_ns, event, walk_m_s, gate
        )
        is_unsure = max(covariance[3, 3], covariance[4, 4]) > _UNSURE_M_S**2
        if isinstance(event, Velocity) and is_unsure and not agrees:
            return state, covariance, refused
        new_state, new_covariance, distance = gated_update(
            state, covariance, innovation, jac, noise, gate
        )
        self._judged[kind, distance <= gate] += 1
        if distance <= gate:
            if kind in refused:
                refused = {k: v for k, v in refused.items() if k is not kind}
            return new_state, new_covariance, refused
        self.num_outliers += 1
        since_ns = refused.get(kind, stamp_ns)
        if stamp_ns - since_ns < self._config.gate_reset_s * 1e9:
            return state, covariance, {**refused, kind: since_ns}
        # The filter itself must be wrong by now.
        kept = {k: v for k, v in refused.items() if k is not kind}
        if agrees:  # and has gone the wrong way all the time
            covariance = doubted(state, covariance, jac, innovation, (stamp_ns - since_ns) * 1e-9)
            return *gated_update(state, covariance, innovation, jac, noise, -1.0)[:2], kept
        # Take the measurement, but no better than it fits.
        wide = noise + np.outer(innovation, innovation)
        new_state, new_covariance, _ = gated_update(state, covariance, innovation, jac, wide, -1.0)
        return new_state, new_covariance, kept

    def _predicted(self, record: _Record, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        dt_s = (stamp_ns - record.key[0]) * 1e-9
        if dt_s <= 0.0:
            return record.state, record.covariance
        state, covariance = predict(record.state, record.covariance, dt_s, self._noise)
        return state, covariance

    def _at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        if not self._records:
            raise InvalidInputError(
                "the filter has no measurement yet, expected yaw or velocity first"
            )
        position = bisect.bisect_right(self._records, stamp_ns, key=lambda record: record.key[0])
        return self._predicted(self._records[max(position - 1, 0)], stamp_ns)

    def _forget(self) -> None:
        limit_ns = self._records[-1].key[0] - int(self._memory_s * 1e9)
        position = bisect.bisect_left(self._records, limit_ns, key=lambda record: record.key[0])
        # In steps, so that the list is not moved for every message.
        if position > 64:
            del self._records[: position - 1]
