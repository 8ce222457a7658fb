"""What a command is told wrongly is told back in one sentence, and nothing is started."""

import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.ros.nodes import bag_player
from uw_dslam_ros2.ros.plumbing.running import run_node

pytestmark = pytest.mark.ros

COMMANDS = {
    "a node": lambda arguments: run_node("a_node", pytest.fail, arguments),
    "bag_player": lambda arguments: bag_player.main(["bag_player", *arguments]),
}


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "Couldn't parse params file"),
        ("/**:\n  ros__parameters: [", "Couldn't parse params file"),
    ],
    ids=["no file", "no YAML"],
)
def test_a_settings_file_that_cannot_be_read_is_named(name, content, expected, tmp_path, capfd):
    file = tmp_path / "settings.yaml"
    if content is not None:
        file.write_text(content)
    assert COMMANDS[name](["--ros-args", "--params-file", str(file)]) == 1
    told = capfd.readouterr().err
    assert expected in told
    assert str(file) in told
    assert ".c:" not in told


@pytest.mark.parametrize(
    ("arguments", "refused"),
    [
        (["--help"], "--help"),
        (["-p", "autostart:=false"], "-p"),  # rcl takes the rest for a remapping of old
        (["--params-file", "a.yaml"], "--params-file a.yaml"),
        (["sonar", "--ros-args", "-p", "a:=1"], "sonar"),
    ],
)
def test_what_would_be_left_out_is_refused(arguments, refused, capfd):
    assert COMMANDS["a node"](arguments) == 1
    told = capfd.readouterr().err
    assert f"arguments {refused} are none of ROS" in told
