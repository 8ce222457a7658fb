"""Settings as ROS parameters: every field of a `Config` is declared, with its text and range."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from uw_dslam_ros2.core.config import Config
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.io.settings import REMOVED, SECTIONS
from uw_dslam_ros2.ros.plumbing.node_settings import names_of_all_nodes
from uw_dslam_ros2.ros.plumbing.qos_overrides import QOS_HEAD, QosOverrides, given_parameters

__all__ = ["declare_config", "held_config", "refuse_unknown_parameters", "settings_of"]

_OWN_TO_RCLPY = ("use_sim_time", "start_type_description_service")
_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
}
_ARRAY_TYPES = {
    bool: Parameter.Type.BOOL_ARRAY,
    int: Parameter.Type.INTEGER_ARRAY,
    float: Parameter.Type.DOUBLE_ARRAY,
    str: Parameter.Type.STRING_ARRAY,
}


def declare_config[ConfigT: Config](
    node: Node, config_type: type[ConfigT], prefix: str = "", *, is_read_only: bool = True
) -> ConfigT:
    """Declare a parameter per field (dotted names for nested ones); build the settings of them.

    Who declares them not read-only decides by a callback what may be set when.

    Raises
    ------
    ConfigError
        If a value given to the node has the wrong type or lies outside its range; the text names
        the parameter.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(config_type):
        name = f"{prefix}.{field.name}" if prefix else field.name
        if isinstance(field.default, Config):
            values[field.name] = declare_config(
                node, type(field.default), name, is_read_only=is_read_only
            )
        else:
            kind = parameter_type(config_type, field)
            values[field.name] = _declare(node, name, field, kind, is_read_only=is_read_only)
    return config_type(**values)  # __post_init__ checks again, choices included


def held_config[ConfigT: Config](
    node: Node,
    config_type: type[ConfigT],
    prefix: str = "",
    given: Mapping[str, Any] | None = None,
) -> ConfigT:
    """Settings as a node's declared parameters are now, or would be with those given.

    Raises
    ------
    ConfigError
        If a value lies outside its range or is none of its choices.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(config_type):
        name = f"{prefix}.{field.name}" if prefix else field.name
        if isinstance(field.default, Config):
            values[field.name] = held_config(node, type(field.default), name, given)
            continue
        # An empty list has no value for rclpy, see `_declare`.
        value = given[name] if given and name in given else node.get_parameter_or(name).value
        values[field.name] = tuple(value or ()) if isinstance(field.default, tuple) else value
    return config_type(**values)


def parameter_type(config_type: type[Config], field: dataclasses.Field[Any]) -> Parameter.Type:
    """Type of the ROS parameter that stands for a field."""
    if isinstance(field.default, tuple):
        hint = typing.get_type_hints(config_type)[field.name]
        return _ARRAY_TYPES[typing.get_args(hint)[0]]
    return _TYPES[type(field.default)]


def _declare(
    node: Node,
    name: str,
    field: dataclasses.Field[Any],
    kind: Parameter.Type,
    *,
    is_read_only: bool,
) -> Any:
    low: Any = field.metadata.get("low")
    high: Any = field.metadata.get("high")
    choices = field.metadata.get("choices")
    descriptor = ParameterDescriptor(
        description=field.metadata.get("doc", ""),
        read_only=is_read_only,
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
    )
    if kind == Parameter.Type.INTEGER and None not in (low, high):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    elif kind == Parameter.Type.DOUBLE and None not in (low, high):
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [bounds]
    default = list(field.default) if isinstance(field.default, tuple) else field.default
    # rclpy cannot tell the type of an empty list, so such a parameter is declared by type and
    # stays unset.
    is_empty_array = default == []
    try:
        parameter = node.declare_parameter(name, kind if is_empty_array else default, descriptor)
    except InvalidParameterTypeException as error:
        given = given_parameters(node)[name].value
        hint = f"; write {given}.0" if kind == Parameter.Type.DOUBLE and type(given) is int else ""
        raise ConfigError(
            f"parameter {name} is {given!r} ({type(given).__name__}), "
            f"expected {kind.name.lower()}{hint}"
        ) from error
    except InvalidParameterValueException as error:
        value = given_parameters(node)[name].value
        raise ConfigError(
            f"parameter {name} is {value!r}, expected {low} to {high}: "
            f"{field.metadata.get('doc', '')}"
        ) from error
    value = () if parameter.type_ == Parameter.Type.NOT_SET else parameter.value
    if choices and value not in choices:
        raise ConfigError(f"parameter {name} is {value!r}, expected one of {', '.join(choices)}")
    return tuple(value) if isinstance(field.default, tuple) else value


def refuse_unknown_parameters(node: Node) -> None:
    """Raise `ConfigError` if the node was given a parameter that it does not have.

    One file may hold the parameters of all nodes under ``/**``: a node skips the others'.
    """
    anothers = names_of_all_nodes()
    can_override = isinstance(node, QosOverrides)
    own = {name.split(".")[0] for name in _declared(node)}
    for name in sorted(given_parameters(node)):
        head = name.split(".")[0]
        is_anothers = name in anothers or (head in SECTIONS and head not in own)
        if node.has_parameter(name) or name in _OWN_TO_RCLPY or is_anothers:
            continue
        if head == QOS_HEAD and can_override:
            continue
        if head == QOS_HEAD:
            raise ConfigError(
                f"parameter {name} would change nothing: {node.get_name()} has the quality of "
                "service that the documentation of its topics says"
            )
        if name in REMOVED:
            raise ConfigError(f"parameter {name} is no setting any more; {REMOVED[name]}")
        raise ConfigError(
            f"parameter {name} is unknown to {node.get_name()}; {_nearest(name, _declared(node))}"
        )


def _declared(node: Node) -> list[str]:
    names = node.get_parameters_by_prefix("")
    return sorted(name for name in names if not name.startswith(f"{QOS_HEAD}."))


def _nearest(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3)
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"it has {', '.join(known)}"


def settings_of(
    config_type: type[Config], prefix: str = ""
) -> Iterator[tuple[str, type[Config], dataclasses.Field[Any]]]:
    """Every plain field, nested ones included, with its parameter name; for documentation."""
    for field in dataclasses.fields(config_type):
        name = f"{prefix}.{field.name}" if prefix else field.name
        if isinstance(field.default, Config):
            yield from settings_of(type(field.default), name)
        else:
            yield name, config_type, field
