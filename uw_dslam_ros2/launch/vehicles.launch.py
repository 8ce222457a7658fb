"""Any number of vehicles from bags, with a registration server and the map-queue manager.

::

    ros2 launch uw_dslam_ros2 vehicles.launch.py bags:="mission/auv_1 mission/auv_2" rate:=5.0

The vehicles in the bags and their topics are found as `offline` finds them, unless `vehicles`
names one for each bag. Without bags, `n` live vehicles auv_1, auv_2, ... are mapped, and each
finds its sensors below its namespace.
"""

from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from uw_dslam_ros2.io.vehicles import find_recordings

PACKAGE = "uw_dslam_ros2"


def text_of(context, name):
    """Value of a launch argument."""
    return LaunchConfiguration(name).perform(context).strip()


def recordings_of(context, bags):
    """Recordings by the vehicle's name, where nobody names the vehicles."""
    if text_of(context, "vehicles") or not bags or not all(Path(bag).exists() for bag in bags):
        return {}
    recordings, findings = find_recordings(bags)
    for finding in findings:
        get_logger("vehicles").warning(finding.sentence)
    return {recording.vehicle_id: recording for recording in recordings}


def vehicles_of(context, bags):
    """Names of the vehicles, checked against the number of bags."""
    names = text_of(context, "vehicles").split()
    if not names and bags:
        names = [Path(bag).stem for bag in bags]
    if not names:
        names = [f"auv_{index + 1}" for index in range(int(text_of(context, "n") or 0))]
    if not names:
        raise RuntimeError("give bags:=..., vehicles:=... or n:=..., all are empty")
    if bags and len(bags) != len(names):
        raise RuntimeError(f"{len(names)} vehicles ({' '.join(names)}) for {len(bags)} bags")
    if len(set(names)) != len(names):
        raise RuntimeError(f"two vehicles have the same name: {' '.join(names)}")
    return names


def topic_parameters(recording):
    """What a mapper must be told of topics that it would not find below its namespace."""
    if recording is None or recording.namespace == recording.vehicle_id:
        return []
    topics = {f"topics.{r}": t for r, t in recording.topics.items() if r != "truth"}
    tail = recording.namespace.split("/")[-1]
    return [topics | ({"base_frame": f"{tail}/base_link"} if tail else {})]


def make_nodes(context):
    """All nodes, by the arguments."""
    bags = [str(Path(bag).expanduser().resolve()) for bag in text_of(context, "bags").split()]
    n = text_of(context, "n")
    bags = bags[: int(n)] if n else bags
    is_replay = bool(bags)
    recordings = recordings_of(context, bags)
    names = list(recordings) or vehicles_of(context, bags)
    clock = {"use_sim_time": is_replay}
    config = LaunchConfiguration("config_dir").perform(context)
    replay_settings = [f"{config}/replay.yaml"] if is_replay else []
    session = text_of(context, "session")
    nodes = [
        Node(
            package=PACKAGE,
            executable="sonar_mapper",
            namespace=name,
            parameters=[
                f"{config}/sonar_mapper.yaml",
                *replay_settings,
                *(
                    [text_of(context, "mapper_config")]
                    if text_of(context, "mapper_config")
                    else []
                ),
                *topic_parameters(recordings.get(name)),
                {"session": f"{session}/mappers/{name}" if session else ""},
                clock,
            ],
            output="screen",
        )
        for name in names
    ]
    nodes.append(
        Node(
            package=PACKAGE,
            executable="registration_server",
            parameters=[f"{config}/registration_server.yaml", clock],
            output="screen",
        )
    )
    nodes.append(
        Node(
            package=PACKAGE,
            executable="map_queue_manager",
            parameters=[
                f"{config}/map_queue_manager.yaml",
                {"vehicles": names, "session": session},
                clock,
            ],
            output="screen",
        )
    )
    nodes.append(
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=[
                "-d",
                PathJoinSubstitution([FindPackageShare(PACKAGE), "rviz", "uw_dslam.rviz"]),
            ],
            parameters=[clock],
            condition=IfCondition(LaunchConfiguration("rviz")),
        )
    )
    nodes.append(
        Node(
            package="diagnostic_aggregator",
            executable="aggregator_node",
            name="analyzers",
            parameters=[
                PathJoinSubstitution([FindPackageShare(PACKAGE), "launch", "aggregator.yaml"])
            ],
            condition=IfCondition(LaunchConfiguration("aggregator")),
        )
    )
    if not is_replay:
        return nodes
    player = Node(
        package=PACKAGE,
        executable="bag_player",
        parameters=[
            {
                "bags": bags,
                "rate": float(text_of(context, "rate")),
                "start_s": float(text_of(context, "start")),
                "duration_s": float(text_of(context, "duration")),
                "max_lag_s": 10.0,
                "wait_for": [
                    recordings[name].topics.get("imu", f"/{name}/imu")
                    if name in recordings
                    else f"/{name}/imu"
                    for name in names
                ],
            }
        ],
        output="screen",
    )
    nodes.append(player)
    if text_of(context, "exit_at_end") == "true":
        stop = EmitEvent(event=Shutdown(reason="the bags are played"))
        nodes.append(RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[stop])))
    return nodes


def generate_launch_description():
    """Arguments: see ``ros2 launch uw_dslam_ros2 vehicles.launch.py --show-args``."""
    share = FindPackageShare(PACKAGE)
    arguments = {
        "bags": ("", "bags to play, one per vehicle, separated by blanks; empty: live vehicles"),
        "n": ("", "number of vehicles; with bags: only the first n of them"),
        "vehicles": (
            "",
            "names (namespaces), separated by blanks; empty: the bags' names, auv_1 ..",
        ),
        "rate": ("1.0", "recorded seconds per second"),
        "start": ("0.0", "begin this long after the first message [s]"),
        "duration": ("0.0", "play this much [s]; 0: to the end"),
        "session": ("", "folder in which all is kept over a restart; empty: none"),
        "mapper_config": ("", "a further YAML file for the mappers"),
        "exit_at_end": ("false", "end everything when the bags are played"),
        "rviz": ("false", "start RViz"),
        "aggregator": ("false", "start the diagnostic_aggregator with a tree of all nodes"),
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in arguments.items()
            ),
            DeclareLaunchArgument(
                "config_dir",
                default_value=PathJoinSubstitution([share, "config"]),
                description="folder of the settings",
            ),
            OpaqueFunction(function=make_nodes),
        ]
    )
