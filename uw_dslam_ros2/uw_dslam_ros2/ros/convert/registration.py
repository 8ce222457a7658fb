"""Messages of what a registration is asked and answers, to core types and back.

rclpy does not check field types unless told to, so every number that goes into a message passes
``float()`` or ``int()``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from uw_dslam_msgs.msg import Registration, RegistrationOptions, RegistrationRival, Transform2D

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    RegistrationResult,
    Rival,
    Verdict,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import (
    check_covariance,
    covariance_to_list,
    transform2d_from_msg,
    transform2d_to_msg,
)

__all__ = [
    "options_from_msg",
    "options_to_msg",
    "registration_from_msg",
    "registration_to_msg",
]


def options_from_msg(msg: RegistrationOptions) -> tuple[PriorWindow | None, float]:
    """Search window (None: all of SE(2)) and time limit [s] (0: the server's setting)."""
    if not (math.isfinite(msg.max_seconds) and msg.max_seconds >= 0.0):
        raise InvalidInputError(
            f"options.max_seconds is {msg.max_seconds} s, "
            "expected 0 (the server's setting) or a positive number"
        )
    if not msg.has_prior:
        return None, float(msg.max_seconds)
    T_target_source = transform2d_from_msg(msg.prior, "options.prior")
    for field, high in (("prior_half_width_m", math.inf), ("prior_half_width_rad", math.pi)):
        value = getattr(msg, field)
        if not (math.isfinite(value) and 0.0 < value <= high):
            raise InvalidInputError(
                f"options.{field} is {value}, expected a number above 0"
                + (f" and at most {high:.6f}" if math.isfinite(high) else "")
            )
    window = PriorWindow(T_target_source, msg.prior_half_width_m, msg.prior_half_width_rad)
    return window, float(msg.max_seconds)


def options_to_msg(prior: PriorWindow | None, max_seconds: float = 0.0) -> RegistrationOptions:
    """Message of a search window and a time limit."""
    msg = RegistrationOptions(max_seconds=float(max_seconds))
    if prior is not None:
        msg.has_prior = True
        msg.prior = transform2d_to_msg(prior.T_target_source)
        msg.prior_half_width_m = float(prior.half_width_m)
        msg.prior_half_width_rad = min(float(prior.half_width_rad), math.pi)
    return msg


_PLAIN_FLOATS = (
    "probability",
    "score",
    "lower_bound",
    "upper_bound",
    "seconds",
    "overlap",
    "conflict_ratio",
    "inlier_ratio",
)


def registration_to_msg(result: RegistrationResult) -> Registration:
    """Message of a registration's outcome."""
    msg = Registration(verdict=int(result.verdict), reason=result.reason)
    msg.t_target_source = transform2d_to_msg(result.T_target_source)
    msg.covariance = covariance_to_list(result.covariance)
    for name in _PLAIN_FLOATS:
        setattr(msg, name, float(getattr(result, name)))
    msg.gap = float(result.gap)
    msg.is_certified = bool(result.is_certified)
    msg.num_boxes = int(result.num_boxes)
    msg.num_source_points = int(result.num_source_points)
    msg.num_target_points = int(result.num_target_points)
    msg.rivals = [_rival_to_msg(rival) for rival in result.rivals]
    return msg


def _transform_from_msg(msg: Transform2D, verdict: Verdict, name: str) -> SE2 | None:
    is_none = all(math.isnan(value) for value in (msg.x, msg.y, msg.yaw))
    if is_none and verdict is not Verdict.ACCEPTED:
        return None
    return transform2d_from_msg(msg, name)


def _rival_to_msg(rival: Rival) -> RegistrationRival:
    return RegistrationRival(
        t_target_source=transform2d_to_msg(rival.T_target_source),
        score=float(rival.score),
        upper_bound=float(rival.upper_bound),
    )


def registration_from_msg(msg: Registration) -> RegistrationResult:
    """Outcome of a registration; raises `InvalidInputError` for one that nobody filled in."""
    if msg.verdict not in {int(verdict) for verdict in Verdict}:
        raise InvalidInputError(
            f"registration.verdict is {msg.verdict}, "
            f"expected {min(Verdict).value} to {max(Verdict).value}"
        )
    verdict = Verdict(msg.verdict)
    covariance = np.array(msg.covariance, dtype=np.float64).reshape(3, 3)
    if verdict is Verdict.ACCEPTED:
        check_covariance(covariance, "registration.covariance")
    return RegistrationResult(
        verdict=verdict,
        reason=msg.reason,
        T_target_source=_transform_from_msg(
            msg.t_target_source, verdict, "registration.t_target_source"
        ),
        covariance=covariance,
        probability=float(msg.probability),
        score=float(msg.score),
        lower_bound=float(msg.lower_bound),
        upper_bound=float(msg.upper_bound),
        is_certified=bool(msg.is_certified),
        num_boxes=int(msg.num_boxes),
        seconds=float(msg.seconds),
        overlap=float(msg.overlap),
        conflict_ratio=float(msg.conflict_ratio),
        inlier_ratio=float(msg.inlier_ratio),
        num_source_points=int(msg.num_source_points),
        num_target_points=int(msg.num_target_points),
        rivals=_rivals_from_msg(msg.rivals),
    )


def _rivals_from_msg(msgs: Sequence[RegistrationRival]) -> tuple[Rival, ...]:
    return tuple(
        Rival(transform2d_from_msg(r.t_target_source, "rival"), r.score, r.upper_bound)
        for r in msgs
    )
