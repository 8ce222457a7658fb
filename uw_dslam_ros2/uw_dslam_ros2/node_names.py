"""Names of the nodes, for the build, the commands that start them, and settings files.

Imports nothing: the build reads it before anything is installed.
"""

__all__ = ["EXECUTABLES", "NODES"]

NODES = (
    "sonar_mapper",
    "registration_server",
    "map_queue_manager",
    "bag_player",
    "acoustic_link",
    "channel",
    "view",
)

EXECUTABLES = (*NODES, "container")
"""What is started as a node: these, and several of them in one process."""
