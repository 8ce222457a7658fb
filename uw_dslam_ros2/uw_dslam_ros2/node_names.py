"""Names of the nodes, for the build, the commands that start them, and settings files.

Imports nothing: the build reads it before anything is installed.
"""

__all__ = ["NODES"]

NODES = (
    "sonar_mapper",
    "registration_server",
    "map_queue_manager",
    "bag_player",
    "acoustic_link",
    "channel",
    "view",
)
