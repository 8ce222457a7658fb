"""Message definitions for reading and writing bags where there is no ROS."""

from __future__ import annotations

import os
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.drivers.definitions import DEFINITIONS

__all__ = ["interface_folders", "make_typestore"]

# Beyond what the library knows of ROS 2 Jazzy.
_PACKAGES = ("uw_dslam_msgs", "marine_acoustic_msgs", "map_msgs")
_REPOSITORY = Path(__file__).resolve().parents[3]


def interface_folders(package: str) -> list[Path]:
    """Folders that may hold a package's ``.msg`` files, best first.

    The share folders of AMENT_PREFIX_PATH (a sourced workspace), then the repository that this
    file lies in.
    """
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    repository = _REPOSITORY / "uw_dslam_msgs"
    folders = [prefix / "share" / package / "msg" for prefix in prefixes]
    return [*folders, repository / "compat" / package / "msg", repository / "msg"]


def make_typestore() -> Typestore:
    """All message types of ROS 2 Jazzy, ours, and some of drivers.

    Raises
    ------
    DataError
        If the definitions of one of our packages are nowhere to be found.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for package in _PACKAGES:
        for path in _definitions(package):
            store.register(get_types_from_msg(path.read_text(), f"{package}/msg/{path.stem}"))
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def _definitions(package: str) -> list[Path]:
    folders = interface_folders(package)
    if package != "uw_dslam_msgs":
        folders = folders[:-1]
    for folder in folders:
        if paths := sorted(folder.glob("*.msg")):
            return paths
    raise DataError(
        f"the message definitions of {package} were not found; looked in "
        f"{', '.join(map(str, folders))}. Source the workspace that holds it."
    )
