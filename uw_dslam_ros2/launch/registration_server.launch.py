"""One registration server alone: on any machine of the ROS graph, any number of them."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Arguments: name (give each server another one), config."""
    share = FindPackageShare("uw_dslam_ros2")
    config = PathJoinSubstitution([share, "config", "registration_server.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "name", default_value="registration_server", description="name of the node"
            ),
            DeclareLaunchArgument("config", default_value=config, description="settings (YAML)"),
            Node(
                package="uw_dslam_ros2",
                executable="registration_server",
                name=LaunchConfiguration("name"),
                parameters=[LaunchConfiguration("config")],
                output="screen",
            ),
        ]
    )
