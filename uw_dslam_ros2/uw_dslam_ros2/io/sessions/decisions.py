"""Decisions as plain values, for files and for pages: what JSON can hold, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import Decision, DecisionKind
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["decision_from_plain", "decision_to_plain"]

_NUMBERS = ("sigma_m", "sigma_rad", "half_width_m", "half_width_rad")
_IDS = ("source", "target")
_MOTIONS = ("T_target_source", "place")
_COUNTS = ("stamp_ns", "undone", "number")
_TEXTS = ("who", "earth_frame")


def decision_to_plain(decision: Decision) -> dict[str, Any]:
    """By the names of the fields, without those that say nothing; a yaw not known is left out."""
    plain: dict[str, Any] = {"kind": decision.kind.name.lower()}
    for name in (*_COUNTS, *_TEXTS, "is_run", *_NUMBERS):
        value = getattr(decision, name)
        if value and not (isinstance(value, float) and math.isinf(value)):
            plain[name] = value
    for name in _IDS:
        if (submap_id := getattr(decision, name)) is not None:
            plain[name] = list(submap_id)
    for name in _MOTIONS:
        if (motion := getattr(decision, name)) is not None:
            plain[name] = motion.as_array().tolist()
    if decision.kind is DecisionKind.FIX:
        plain["point"] = list(decision.point)
    return plain


def decision_from_plain(plain: Mapping[str, Any]) -> Decision:
    """The decision.

    Raises
    ------
    InvalidInputError
        Naming the field, its value and what is expected.
    """
    known = {"kind", "is_run", "point", *_COUNTS, *_TEXTS, *_NUMBERS, *_IDS, *_MOTIONS}
    if unknown := sorted(set(plain) - known):
        raise InvalidInputError(f"decision holds {unknown}, expected {sorted(known)}")
    name = plain.get("kind")
    if not isinstance(name, str) or name.upper() not in DecisionKind.__members__:
        kinds = ", ".join(kind.name.lower() for kind in DecisionKind)
        raise InvalidInputError(f"decision.kind is {name!r}, expected one of {kinds}")
    kind = DecisionKind[name.upper()]
    values: dict[str, Any] = {n: _typed(plain, n, str) for n in _TEXTS if n in plain}
    values |= {n: _typed(plain, n, int) for n in _COUNTS if n in plain}
    values |= {n: float(_typed(plain, n, (int, float))) for n in _NUMBERS if n in plain}
    values |= {n: _submap_id(plain, n) for n in _IDS if n in plain}
    values |= {n: SE2(*_floats(plain, n, 3)) for n in _MOTIONS if n in plain}
    if "is_run" in plain:
        values["is_run"] = _typed(plain, "is_run", bool)
    if "point" in plain:
        x_m, y_m = _floats(plain, "point", 2)
        values["point"] = (x_m, y_m)
    if kind is DecisionKind.FIX:
        values.setdefault("sigma_rad", math.inf)
    return Decision(kind, **values)


def _typed(plain: Mapping[str, Any], name: str, kind: Any) -> Any:
    value = plain[name]
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        names = getattr(kind, "__name__", "number")
        raise InvalidInputError(f"decision.{name} is {value!r}, expected {names}")
    return value


def _floats(plain: Mapping[str, Any], name: str, count: int) -> list[float]:
    value = plain[name]
    is_right = isinstance(value, (list, tuple)) and len(value) == count
    if not is_right or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) for v in value
    ):
        raise InvalidInputError(f"decision.{name} is {value!r}, expected {count} numbers")
    return [float(v) for v in value]


def _submap_id(plain: Mapping[str, Any], name: str) -> SubmapId:
    value = plain[name]
    is_right = isinstance(value, (list, tuple)) and [type(v) for v in value] == [str, int, int]
    if not is_right:
        raise InvalidInputError(
            f"decision.{name} is {value!r}, expected a vehicle, a run and a sequence number"
        )
    return SubmapId(*value)
