"""Settings files: the layout of ROS parameter files, so that one file serves nodes and commands.

::

    /**:                              # every node; or one by its full name: /auv_1/sonar_mapper:
      ros__parameters:
        mapper:                       # one group of settings, see `SECTIONS`
          submap:
            max_length_m: 25.0        # or, in one piece, mapper.submap.max_length_m: 25.0

The groups may also stand at the top of the file, without the two lines above them. What is said
to one node wins over ``/**``, as in ROS.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from uw_dslam_ros2.core.config import Config
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.node_names import NODES

__all__ = ["REMOVED", "SECTIONS", "SettingsFile"]

SECTIONS = ("mapper", "registration", "points", "queue", "maps", "topics", "conventions")
"""Groups of settings that are part of the core; everything else concerns a node alone."""

REMOVED = {
    "ping_queue": "it is always 100",
    "sensor_queue": "it is always 5000",
    "jump_back_s": "it is always 1 s",
    "path_max_poses": "it is always 2000",
    "mapper.settle_s": "a ping is mapped once all that is earlier has come",
    "mapper.max_wait_s": "a ping is mapped once all that is earlier has come",
    "mapper.sonar.no_echo_free_share": "it is always 0.5",
    "mapper.occupancy.max_spread_m": "it is always 0.5 m",
    "mapper.occupancy.min_motion_m": "it is always 0.1 m",
    "mapper.occupancy.min_turn_rad": "it is always 0.02 rad",
    "mapper.occupancy.min_interval_s": "it is always 1 s",
    "mapper.match.min_points": "it is always 20",
    "mapper.match.max_points": "it is always 300",
    "mapper.match.min_overlap": "it is always 0.3",
    "mapper.loop.search_sigma": "it is always 3",
    "mapper.loop.max_window_m": "it is always 15 m",
    "mapper.loop.max_window_rad": "it is always 0.35 rad",
    "mapper.loop.min_overlap": "it is always 0.3",
    "mapper.loop.sure_overlap": "it is always 0.5",
    "mapper.loop.max_conflict": "it is always 0.2",
    "mapper.loop.min_points": "it is always 60",
    "mapper.loop.max_points": "it is always 600",
    "mapper.particles.min_effective_share": "it is always 0.5",
    "mapper.particles.max_points": "it is always 250",
    "points.min_probability": "it is points.min_posterior now",
    **{
        f"{group}.{name}": text
        for group in ("registration", "mapper.loop.registration")
        for name, text in (
            ("min_probability", f"write 1 less it as {group}.max_false_accept"),
            ("max_conflict", "it is always 0.4"),
            ("max_rival_probability", f"{group}.max_false_accept counts rivals, too"),
            ("max_slide_share", "the covariance says how free a direction is"),
        )
    },
    "queue.log_odds_max": "it is always 8",
    "queue.num_neighbours": "it is always 1",
    "queue.max_checks": "it is always 3",
    "queue.part_length": "it is always 6",
    "queue.max_part_searches": "it is always 4",
    "queue.vague_cells": "it is always 2",
    "queue.vague_share": "it is always 1",
    "queue.inlier_probability": "it is always 0.99",
    "queue.edge_sigma_cells": "it is always 0.25",
}
"""Settings of earlier versions, and what became of them."""

_SENSOR_SETTINGS = {field.name for field in fields(SensorConfig)}
_EVERY_NODE = "/**"
_PARAMETERS = "ros__parameters"

_Tree = dict[str, Any]


class SettingsFile:
    """The content of a settings file, checked for its shape.

    Parameters
    ----------
    path
        A YAML file; None stands for an empty one, so that every setting has its default.

    Raises
    ------
    ConfigError
        Naming the file, the key, its value and what was expected.
    """

    def __init__(self, path: str | Path | None) -> None:
        self.path = None if path is None else Path(path)
        content = {} if self.path is None else _load(self.path)
        self._parts = _split(self._label, content)

    @property
    def _label(self) -> str:
        return "settings" if self.path is None else str(self.path)

    def section[ConfigT: Config](
        self, config_type: type[ConfigT], section: str, node: str
    ) -> ConfigT:
        """One group of settings as a node with a full name such as ``/auv_1/sonar_mapper`` has it.

        Raises
        ------
        ConfigError
            If a key is unknown, or a value has the wrong type or is out of its range.
        """
        merged: _Tree = {}
        for pattern, values in self._parts:
            if _matches(pattern, node) and section in values:
                _check_types(self._label, section, config_type, values[section])
                merged = _merge(merged, values[section])
        try:
            return config_type.from_dict(merged)
        except ConfigError as error:
            raise ConfigError(f"{self._label}: {section}: {error}") from error

    def plain[ConfigT: Config](self, config_type: type[ConfigT], node: str) -> ConfigT:
        """Settings of a node that stand in no group, `topics` aside, as its full name has them.

        Other keys are left alone: they concern the node as a node.

        Raises
        ------
        ConfigError
            If a value has the wrong type or is out of its range.
        """
        names = {field.name for field in fields(config_type)}
        merged: _Tree = {}
        for pattern, values in self._parts:
            if _matches(pattern, node):
                own = {key: value for key, value in values.items() if key in names}
                _check_types(self._label, "", config_type, own)
                merged = _merge(merged, own)
        try:
            return config_type.from_dict(merged)
        except ConfigError as error:
            raise ConfigError(f"{self._label}: {error}") from error


class _Loader(yaml.SafeLoader):
    """Refuses a key that is there twice: YAML would silently drop the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the base class, but refuse keys that are there twice."""
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is there twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _load(path: Path) -> _Tree:
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    return _mapping(str(path), "the file", content)


def _split(label: str, content: _Tree) -> list[tuple[str, _Tree]]:
    """``(node pattern, nested values)``, the most general pattern first."""
    plain = {
        key: value
        for key, value in content.items()
        if key.split(".")[0] in SECTIONS or key in _SENSOR_SETTINGS
    }
    parts = [(_EVERY_NODE, _nested(label, "", plain))] if plain else []
    for key, value in content.items():
        if key in plain:
            continue
        for pattern, values in _node_parts(label, key, value):
            _check_pattern(label, pattern)
            parts.append((pattern, _nested(label, f"{pattern}: ", values)))
    for pattern, values in parts:
        _check_heads(label, pattern, values)
    return sorted(parts, key=lambda part: part[0] != _EVERY_NODE)


def _node_parts(label: str, key: str, value: Any) -> list[tuple[str, _Tree]]:
    """ROS allows namespaces to be nested: ``auv_1: {sonar_mapper: {ros__parameters: ...}}``."""
    if not isinstance(value, Mapping):
        close = _nearest(key.split(".")[0], (*SECTIONS, *NODES))
        raise ConfigError(
            f"{label}: {key} is {value!r}; expected a group ({', '.join(SECTIONS)}) or a node "
            f"with {_PARAMETERS}{close}"
        )
    value = _mapping(label, key, value)
    if _PARAMETERS in value:
        if others := sorted(set(value) - {_PARAMETERS}):
            raise ConfigError(f"{label}: {key} has {others[0]!r} beside {_PARAMETERS}")
        return [(key, _mapping(label, f"{key}: {_PARAMETERS}", value[_PARAMETERS] or {}))]
    if not any(isinstance(inner, Mapping) for inner in value.values()):
        close = _nearest(key.rsplit("/", 1)[-1], (*SECTIONS, *NODES, _PARAMETERS))
        raise ConfigError(
            f"{label}: {key!r} is neither a group of settings ({', '.join(SECTIONS)}) nor a node "
            f"with {_PARAMETERS}{close}"
        )
    found = []
    for name, inner in value.items():
        found += _node_parts(label, f"{key.rstrip('/')}/{name.lstrip('/')}", inner)
    return found


def _mapping(label: str, key: str, value: Any) -> _Tree:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{label}: {key} is {value!r}, expected keys with values")
    if strange := [name for name in value if not isinstance(name, str)]:
        raise ConfigError(f"{label}: {key} has the key {strange[0]!r}, expected a name")
    return dict(value)


def _nested(label: str, where: str, values: _Tree) -> _Tree:
    """Undo dotted names."""
    result: _Tree = {}
    for key, value in values.items():
        is_group = isinstance(value, Mapping)
        inner: Any = _nested(label, f"{where}{key}.", dict(value)) if is_group else value
        for part in reversed(key.split(".")):
            inner = {part: inner}
        result = _merge(result, inner)
    return result


def _merge(base: _Tree, over: _Tree) -> _Tree:
    result = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if both else value
    return result


def _check_pattern(label: str, pattern: str) -> None:
    name = pattern.rsplit("/", 1)[-1]
    if pattern == _EVERY_NODE:
        return
    if "*" in pattern:
        raise ConfigError(
            f"{label}: {pattern!r} would match no node: expected {_EVERY_NODE} or a full name "
            "such as /auv_1/sonar_mapper"
        )
    if name not in NODES:
        raise ConfigError(
            f"{label}: {pattern!r} is no node of this package; there are {', '.join(NODES)}"
            f"{_nearest(name, NODES)}"
        )


def _check_heads(label: str, pattern: str, values: _Tree) -> None:
    """A group with a typing error would be taken for a parameter of a node, and be lost."""
    for key, value in values.items():
        if isinstance(value, dict) and key not in SECTIONS:
            raise ConfigError(
                f"{label}: {pattern}: {key!r} is no group of settings; there are "
                f"{', '.join(SECTIONS)}{_nearest(key, SECTIONS)}"
            )


def _check_types(label: str, name: str, config_type: type[Config], values: Any) -> None:
    """What rclpy would refuse is refused here too, so that a file is right or wrong for both."""
    for key, value in _mapping(label, name, values).items():
        dotted = f"{name}.{key}" if name else key
        field = next((field for field in fields(config_type) if field.name == key), None)
        if field is None and dotted in REMOVED:
            raise ConfigError(f"{label}: {dotted} is no setting any more; {REMOVED[f'{dotted}']}")
        if field is None:
            known = [field.name for field in fields(config_type)]
            raise ConfigError(
                f"{label}: {dotted} is unknown; {name} has {', '.join(known)}"
                f"{_nearest(key, known)}"
            )
        default = field.default
        if isinstance(default, Config):
            _check_types(label, dotted, type(default), value)
        elif isinstance(default, float) and type(value) is int:
            raise ConfigError(
                f"{label}: {dotted} is {value}, an integer, expected a float: write {value}.0"
            )
        elif not isinstance(default, tuple) and type(value) is not type(default):
            raise ConfigError(
                f"{label}: {dotted} is {value!r} ({type(value).__name__}), "
                f"expected {type(default).__name__}: {field.metadata.get('doc', '')}"
            )
        else:
            _check_value(label, name, config_type, key, value)


def _check_value(label: str, name: str, config_type: type[Config], key: str, value: Any) -> None:
    try:
        config_type(**{key: value})
    except ConfigError as error:
        reason = str(error).removeprefix(f"{config_type.__name__}.{key} ")
        dotted = f"{name}.{key}" if name else key
        raise ConfigError(f"{label}: {dotted} {reason}") from error


def _nearest(name: str, known: tuple[str, ...] | list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""


def _matches(pattern: str, node: str) -> bool:
    """As rclpy does: ``/**``, or the node's full name (with or without the first slash)."""
    return pattern == _EVERY_NODE or "/" + pattern.strip("/") == node
