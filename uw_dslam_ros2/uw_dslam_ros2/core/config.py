"""Settings: frozen dataclasses whose bounds and text live with the default.

YAML files and ROS parameters derive from them.

::

    @dataclass(frozen=True, slots=True)
    class SubmapConfig(Config):
        "When a submap closes."
        max_length_m: float = setting(25.0, 1.0, 1000.0, "path length after which a submap closes")
        is_enabled: bool = setting(True, doc="...")
        method: str = setting("cfar", choices=("cfar", "threshold"), doc="...")
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from uw_dslam_ros2.core.errors import ConfigError

__all__ = ["Config", "setting"]


def setting(
    default: Any,
    low: float | None = None,
    high: float | None = None,
    doc: str = "",
    *,
    choices: Sequence[str] | None = None,
    is_basic: bool = False,
) -> Any:
    """Field of a `Config`: default, inclusive bounds of numbers, a line of text with the unit.

    Users have reason to set what is basic, since it says what their sensor, vehicle or mission is
    like; every other setting is for experts, and documented apart.
    """
    metadata = {
        "low": low, "high": high, "doc": doc, "choices": tuple(choices or ()),
        "is_basic": is_basic,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class Config:
    """Base of all settings; checks every field against its type and bounds."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            object.__setattr__(self, field.name, self._checked(field, value))

    @classmethod
    def _checked(cls, field: dataclasses.Field[Any], value: Any) -> Any:
        name = f"{cls.__name__}.{field.name}"
        default = field.default
        if isinstance(default, Config):
            if not isinstance(value, type(default)):
                raise ConfigError(f"{name} is {value!r}, expected a {type(default).__name__}")
            return value
        if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if isinstance(default, tuple) and isinstance(value, list):
            value = tuple(value)
        if type(value) is not type(default):
            raise ConfigError(
                f"{name} is {value!r} ({type(value).__name__}), expected {type(default).__name__}"
            )
        low, high = field.metadata.get("low"), field.metadata.get("high")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{name} is {value}, expected a finite number")
        if (low is not None and value < low) or (high is not None and value > high):
            raise ConfigError(f"{name} is {value}, expected {low} to {high}")
        choices = field.metadata.get("choices")
        if choices and value not in choices:
            raise ConfigError(f"{name} is {value!r}, expected one of {', '.join(choices)}")
        return value

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Build from nested plain values (a YAML file's); unknown keys raise `ConfigError`."""
        known = {field.name: field for field in dataclasses.fields(cls)}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ConfigError(
                f"{cls.__name__} has no setting {unknown[0]!r}; it has {', '.join(sorted(known))}"
            )
        arguments: dict[str, Any] = {}
        for name, value in values.items():
            default = known[name].default
            if isinstance(default, Config):
                if not isinstance(value, Mapping):
                    raise ConfigError(f"{cls.__name__}.{name} is {value!r}, expected a mapping")
                value = type(default).from_dict(value)
            arguments[name] = value
        return cls(**arguments)

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, tuples as lists; `from_dict` undoes it."""
        result: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Config):
                value = value.to_dict()
            result[field.name] = list(value) if isinstance(value, tuple) else value
        return result
