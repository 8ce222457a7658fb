"""Settings files: what they may look like, and what is said about those that are wrong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.mapping import VehicleMapperConfig
from uw_dslam_ros2.core.merging import MapQueueConfig
from uw_dslam_ros2.core.registration import GridRegistrationConfig, RegistrationConfig
from uw_dslam_ros2.io.settings import REMOVED, SettingsFile


@dataclass(frozen=True, slots=True)
class _Inner(Config):
    max_length_m: float = setting(25.0, 1.0, 100.0, "path length")
    sizes: tuple[int, ...] = setting((1, 2), doc="sizes")


@dataclass(frozen=True, slots=True)
class _Mapper(Config):
    submap: _Inner = _Inner()
    method: str = setting("a", choices=("a", "b"), doc="method")
    is_enabled: bool = setting(True, doc="switch")
    num_beams: int = setting(4, 1, 8, "beams")


NODE = "/auv_1/sonar_mapper"


def _read(tmp_path: Path, text: str, node: str = NODE) -> _Mapper:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    return SettingsFile(path).section(_Mapper, "mapper", node)


def test_no_file_means_the_defaults() -> None:
    assert SettingsFile(None).section(_Mapper, "mapper", NODE) == _Mapper()


@pytest.mark.parametrize(
    "text",
    [
        "mapper: {submap: {max_length_m: 12.5, sizes: [3]}, method: b}",
        "mapper.submap.max_length_m: 12.5\nmapper.submap.sizes: [3]\nmapper.method: b",
        "/**:\n  ros__parameters:\n    mapper:\n      method: b\n"
        "      submap: {max_length_m: 12.5, sizes: [3]}",
        "/**:\n  ros__parameters:\n    use_sim_time: true\n    mapper.method: b\n"
        "    mapper: {submap.max_length_m: 12.5, submap: {sizes: [3]}}",
        "/auv_1/sonar_mapper:\n  ros__parameters:\n"
        "    mapper: {submap: {max_length_m: 12.5, sizes: [3]}, method: b}",
        "auv_1:\n  sonar_mapper:\n    ros__parameters:\n"
        "      mapper: {submap: {max_length_m: 12.5, sizes: [3]}, method: b}",
    ],
    ids=["plain", "dotted", "every node", "mixed", "one node", "nested namespace"],
)
def test_every_layout_says_the_same(tmp_path: Path, text: str) -> None:
    expected = _Mapper(submap=_Inner(max_length_m=12.5, sizes=(3,)), method="b")
    assert _read(tmp_path, text) == expected


def test_one_node_wins_over_every_node_in_either_order(tmp_path: Path) -> None:
    general = "/**:\n  ros__parameters:\n    mapper: {num_beams: 2, method: b}\n"
    particular = f"{NODE}:\n  ros__parameters:\n    mapper: {{num_beams: 3}}\n"
    for text in (general + particular, particular + general):
        assert _read(tmp_path, text) == _Mapper(num_beams=3, method="b")
        assert _read(tmp_path, text, "/auv_2/sonar_mapper") == _Mapper(num_beams=2, method="b")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("mapper: {metod: b}", ["mapper.metod is unknown", "did you mean method?"]),
        ("mapper: {submap: {max_lenth_m: 2.0}}", ["mapper.submap.max_lenth_m", "max_length_m?"]),
        ("maper: {method: b}", ["'maper'", "did you mean mapper?"]),
        ("maper: 3", ["maper is 3", "did you mean mapper?"]),
        ("mapper: {submap: {max_length_m: 12}}", ["mapper.submap.max_length_m is 12", "12.0"]),
        ("mapper: {submap: {max_length_m: .nan}}", ["mapper.submap.max_length_m", "finite"]),
        ("mapper: {submap: {max_length_m: 1000.0}}", ["max_length_m is 1000.0", "1.0 to 100.0"]),
        ("mapper: {num_beams: 2.5}", ["mapper.num_beams is 2.5 (float)", "expected int"]),
        ("mapper: {num_beams: true}", ["mapper.num_beams is True (bool)", "expected int"]),
        ("mapper: {method: c}", ["mapper.method is 'c'", "one of a, b"]),
        ("mapper: {is_enabled: 1}", ["mapper.is_enabled is 1", "bool"]),
        ("mapper: 3", ["mapper is 3", "expected keys"]),
        ("mapper: {submap: 3}", ["mapper.submap is 3", "expected keys"]),
        ("[1, 2]", ["the file is [1, 2]"]),
        ("mapper: {num_beams: 2, num_beams: 3}", ["'num_beams' is there twice"]),
        ("mapper: {", ["not a YAML file"]),
        (
            "/**/sonar_mapper: {ros__parameters: {mapper: {num_beams: 2}}}",
            ["would match no node", "/auv_1/sonar_mapper"],
        ),
        (
            "/auv_1/sonar_maper: {ros__parameters: {mapper: {num_beams: 2}}}",
            ["no node of this package", "did you mean sonar_mapper?"],
        ),
        ("/**: {ros__parameters: {maper: {num_beams: 2}}}", ["'maper'", "did you mean mapper?"]),
        ("/**: {ros_parameters: {mapper: 3}}", ["neither", "did you mean ros__parameters?"]),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        _read(tmp_path, text)
    message = str(caught.value)
    assert str(tmp_path / "settings.yaml") in message
    for part in parts:
        assert part in message


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*nothing\.yaml: No such file"):
        SettingsFile(tmp_path / "nothing.yaml")


def test_setting_of_an_earlier_version_is_refused_by_what_became_of_it(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("queue: {max_checks: 5}\n")
    with pytest.raises(ConfigError, match=r"queue\.max_checks is no setting any more.*always 3"):
        SettingsFile(path).section(MapQueueConfig, "queue", "/map_queue_manager")


@pytest.mark.parametrize("name", sorted(REMOVED))
def test_removed_settings_are_removed(name):
    group, _, rest = name.partition(".")
    settings = {
        "mapper": VehicleMapperConfig(),
        "queue": MapQueueConfig(),
        "points": RegistrationConfig(),
        "registration": GridRegistrationConfig(),
    }
    inner = settings[group].to_dict() if rest else {}
    for part in rest.split("."):
        assert part not in inner or isinstance(inner[part], dict)
        inner = inner.get(part, {})
