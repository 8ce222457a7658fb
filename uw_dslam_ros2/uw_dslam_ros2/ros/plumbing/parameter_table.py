"""Writes the tables of parameters into the documentation, from the settings themselves.

docs/interfaces.md has the parameters that users have a reason to set, docs/parameters-expert.md
all others::

    ./uw python -m uw_dslam_ros2.ros.plumbing.parameter_table docs/interfaces.md \
        docs/parameters-expert.md
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uw_dslam_ros2.core.config import Config
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.link import LinkConfig
from uw_dslam_ros2.core.link.transport.channel import ChannelConfig
from uw_dslam_ros2.core.mapping import VehicleMapperConfig
from uw_dslam_ros2.core.merging import GrowingMapConfig, MapQueueConfig
from uw_dslam_ros2.core.registration import GridRegistrationConfig, RegistrationConfig
from uw_dslam_ros2.ros.plumbing.node_settings import NODE_CONFIGS
from uw_dslam_ros2.ros.plumbing.parameters import parameter_type, settings_of

__all__ = ["GROUPS", "parameter_tables", "with_tables"]

GROUPS: dict[str, tuple[tuple[str, type[Config]], ...]] = {
    "sonar_mapper": (("mapper", VehicleMapperConfig),),
    "registration_server": (
        ("registration", GridRegistrationConfig),
        ("points", RegistrationConfig),
    ),
    "map_queue_manager": (("queue", MapQueueConfig), ("maps", GrowingMapConfig)),
    "bag_player": (),
    "view": (),
    "acoustic_link": (("link", LinkConfig),),
    "channel": (("channel", ChannelConfig),),
}
"""Groups of parameters of each node, beside its own."""

_BEGIN = "<!-- {} parameters: written by uw_dslam_ros2.ros.plumbing.parameter_table -->"
_END = "<!-- end of parameters -->"


def parameter_tables(*, is_basic: bool) -> str:
    """Tables of the parameters of all nodes, in Markdown: the basic ones, or all others."""
    parts = []
    for node, own in NODE_CONFIGS.items():
        items = list(settings_of(own))
        for prefix, config_type in GROUPS[node]:
            items += settings_of(config_type, prefix)
        items = [item for item in items if not _is_repeated(*item)]
        rows = [_row(*item) for item in items if _is_basic(item[2]) == is_basic]
        if not rows:
            continue
        header = "| parameter | type | default | range | meaning |\n|---|---|---|---|---|"
        parts.append(f"### {node}\n\n{header}\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _is_repeated(name: str, _: type[Config], field: dataclasses.Field[Any]) -> bool:
    """Whether a parameter of loops is as the server's of that name, which has its row already."""
    if not name.startswith("mapper.loop.registration."):
        return False
    return bool(field.default == GridRegistrationConfig.__dataclass_fields__[field.name].default)


def _is_basic(field: dataclasses.Field[Any]) -> bool:
    return bool(field.metadata.get("is_basic", False))


def _row(name: str, config_type: type[Config], field: dataclasses.Field[Any]) -> str:
    kind = parameter_type(config_type, field).name.lower().replace("_", " ")
    low, high, choices = (field.metadata.get(key) for key in ("low", "high", "choices"))
    bounds = ""
    if choices:
        bounds = ", ".join(choices)
    elif low is not None and high is not None:
        bounds = f"{low:g} to {high:g}" if kind == "double" else f"{low} to {high}"
    text = field.metadata.get("doc", "").replace("|", "\\|").replace("<", "\\<")
    return f"| `{name}` | {kind} | {_default(field.default)} | {bounds} | {text} |"


def _default(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(map(str, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return '""' if value == "" else str(value)


def with_tables(text: str) -> str:
    """The text of a page, its tables made anew.

    Raises
    ------
    DataError
        If the page has no place for them.
    """
    for kind in ("basic", "expert"):
        begin = _BEGIN.format(kind)
        head, found, rest = text.partition(begin)
        _, end, tail = rest.partition(_END)
        if found and end:
            tables = parameter_tables(is_basic=kind == "basic")
            return f"{head}{begin}\n\n{tables}\n\n{_END}{tail}"
    raise DataError(
        f"no place for the tables: expected a line {_BEGIN.format('basic')!r} and one {_END!r}"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Renew the tables of the pages that are named."""
    for name in sys.argv[1:] if argv is None else argv:
        path = Path(name)
        path.write_text(with_tables(path.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
