"""Files in config/ serve the nodes they are for; the documentation lists every parameter."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

import rclpy
import yaml

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.node_names import NODES as NODES_WITH_SETTINGS
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.nodes.sonar_mapper import SonarMapper
from uw_dslam_ros2.ros.plumbing.node_settings import NODE_CONFIGS
from uw_dslam_ros2.ros.plumbing.parameter_table import GROUPS, parameter_tables, with_tables
from uw_dslam_ros2.ros.plumbing.parameters import settings_of

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "config").glob("*.yaml"))
NODES = {
    "sonar_mapper": SonarMapper,
    "registration_server": RegistrationServer,
    "map_queue_manager": MapQueueManager,
}


@pytest.fixture
def start(ros_domain_id):
    """Start a node with a settings file, as the command line does."""
    made = []

    def run(name, path):
        context = rclpy.Context()
        arguments = ["--ros-args", "--params-file", str(path), "-r", "__ns:=/auv_1"]
        rclpy.init(args=arguments, context=context, domain_id=ros_domain_id)
        made.append(context)
        node = NODES[name](context=context)
        made.append(node)
        return node

    yield run
    for thing in reversed(made):
        thing.try_shutdown() if isinstance(thing, rclpy.Context) else thing.destroy_node()


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_serves_every_node(start, name, path):
    """One file may be given to all nodes of a graph."""
    assert start(name, path).get_name() == name


@pytest.mark.parametrize("name", NODES)
def test_file_of_a_node_has_all_that_users_set_at_its_default(name):
    """Empty lists are left out: ROS cannot tell their type."""
    values = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
    items = [*settings_of(NODE_CONFIGS[name])]
    for prefix, config_type in GROUPS[name]:
        items += settings_of(config_type, prefix)
    basic = {n: f.default for n, _, f in items if f.metadata["is_basic"] and f.default != ()}
    assert _flat(values["/**"]["ros__parameters"]) == basic


def _flat(values, prefix=""):
    found = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        found |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return found


def test_value_of_a_file_reaches_the_node(start, tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    input: points\n"
        "    mapper: {occupancy: {resolution_m: 0.25}}\n    queue: {mode: pairwise}\n"
    )
    node = start("sonar_mapper", path)
    assert node.get_parameter("mapper.occupancy.resolution_m").value == 0.25
    assert node.get_parameter("input").value == "points"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mapper: {occupancy: {resolution: 0.1}}", "mapper.occupancy.resolution is unknown"),
        ("mapper: {occupancy: {resolution_m: 1}}", "write 1.0"),
        ("mapper: {occupancy: {resolution_m: -1.0}}", "resolution_m is -1.0, expected 0.01 to"),
        ("mapper: {match: {min_points: 9}}", "min_points is no setting any more; it is always 20"),
        ("ping_queue: 50", "ping_queue is no setting any more; it is always 100"),
        ("inputt: points", "inputt is unknown to sonar_mapper; did you mean input"),
    ],
)
def test_typing_error_in_a_file_is_refused(start, tmp_path, text, words):
    path = tmp_path / "settings.yaml"
    path.write_text(f"/**:\n  ros__parameters:\n    {text}\n")
    with pytest.raises(ConfigError, match=words):
        start("sonar_mapper", path)


@pytest.mark.parametrize("page", ["interfaces.md", "parameters-expert.md"])
def test_documented_parameters_are_those_of_the_settings(page):
    """`./uw python -m uw_dslam_ros2.ros.plumbing.parameter_table PAGE` renews the tables."""
    text = (ROOT / "docs" / page).read_text()
    assert with_tables(text) == text


def test_every_parameter_has_its_text():
    basic, expert = (_rows(parameter_tables(is_basic=is_basic)) for is_basic in (True, False))
    assert 20 <= len(basic) <= 30
    assert len(expert) > 50
    assert [line for line in (*basic, *expert) if not line.split("|")[5].strip()] == []


def _rows(tables):
    return [line for line in tables.splitlines() if line.startswith("| `")]


def test_a_settings_file_may_name_every_node_that_has_settings():
    assert set(NODES_WITH_SETTINGS) == set(NODE_CONFIGS)


@pytest.mark.parametrize("name", NODES)
def test_the_documentation_says_which_parameters_can_change_while_a_node_runs(name):
    text = (ROOT / "docs" / "interfaces.md").read_text()
    assert [live for live in NODES[name].live if f"`{live}`" not in text] == []
