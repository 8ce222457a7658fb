"""Launch files say what they start; where launch is installed, they are also loaded."""

import importlib.util
from pathlib import Path

import pytest
import yaml

FILES = sorted((Path(__file__).parents[2] / "uw_dslam_ros2" / "launch").glob("*.launch.py"))
AGGREGATOR = Path(__file__).parents[2] / "uw_dslam_ros2" / "launch" / "aggregator.yaml"
RVIZ = Path(__file__).parents[2] / "uw_dslam_ros2" / "rviz" / "uw_dslam.rviz"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_launch_file_is_python(path):
    compile(path.read_text(), str(path), "exec")


@pytest.mark.launch
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_launch_file_is_loaded(path):
    launch = pytest.importorskip("launch")
    pytest.importorskip("launch_ros")
    assert isinstance(load(path).generate_launch_description(), launch.LaunchDescription)


@pytest.mark.launch
@pytest.mark.parametrize(
    ("arguments", "num_mappers", "has_player"),
    [
        ({"n": "4"}, 4, False),
        ({"bags": "/a/auv_1 /b/auv_2"}, 2, True),
        ({"bags": "/a/auv_1 /b/auv_2", "n": "1"}, 1, True),
        ({"vehicles": "alpha beta gamma"}, 3, False),
    ],
)
def test_as_many_vehicles_as_asked(arguments, num_mappers, has_player):
    launch = pytest.importorskip("launch")
    pytest.importorskip("launch_ros")
    module = load(next(path for path in FILES if path.name == "vehicles.launch.py"))
    context = launch.LaunchContext()
    for action in module.generate_launch_description().entities:
        if isinstance(action, launch.actions.DeclareLaunchArgument):
            default = action.default_value
            given = arguments.get(action.name)
            is_plain = all(
                isinstance(part, launch.substitutions.TextSubstitution) for part in default
            )
            text = given or ("".join(part.text for part in default) if is_plain else "/config")
            context.launch_configurations[action.name] = text
    names = [getattr(node, "node_executable", "") for node in module.make_nodes(context)]
    assert names.count("sonar_mapper") == num_mappers
    assert names.count("registration_server") == names.count("map_queue_manager") == 1
    assert ("bag_player" in names) == has_player


def test_every_kind_of_node_has_its_place_among_the_diagnostics():
    """A status is named after the node with its namespace, and again without, by `Diagnostics`."""
    parameters = yaml.safe_load(AGGREGATOR.read_text())["analyzers"]["ros__parameters"]
    groups = [group for group in parameters.values() if isinstance(group, dict)]
    for name in ("sonar_mapper", "registration_server", "map_queue_manager"):
        status = f"auv_1/{name}: {name}"
        takers = [g for g in groups if any(part in status for part in g["contains"])]
        assert len(takers) == 1
    for group in groups:
        assert group["type"] == "diagnostic_aggregator/GenericAnalyzer"
        assert group["timeout"] > 1.0, "one status a second is sent"


def test_rviz_shows_the_maps_and_the_graph():
    text = RVIZ.read_text()
    assert yaml.safe_load(text)["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"
    for topic in (
        "/map",
        "/map_updates",
        "/pose_graph",
        "/auv_1/map",
        "/auv_2/map",
        "/auv_3/path",
    ):
        assert f"Value: {topic}\n" in text
