"""Where the instruments of a vehicle sit, as transforms tell it."""

from __future__ import annotations

import math
import re
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding, Severity
from uw_dslam_ros2.core.mounting import StaticFrames, fan_tilt
from uw_dslam_ros2.io.mounting_changes import MountingChanges
from uw_dslam_ros2.io.readings import (
    DepthEvent,
    FixEvent,
    ImageEvent,
    ImuEvent,
    PoseEvent,
    Reading,
    TransformEvent,
    VelocityEvent,
)
from uw_dslam_ros2.io.topics import NAMES_OF_ROLES, parts_of

__all__ = ["Mountings", "base_frame_of", "role_of", "usual_mounting"]

FloatArray = NDArray[np.float64]

_NEEDS_NONE = DepthEvent | PoseEvent | FixEvent
"""Readings that mean nearly the same wherever on the vehicle they are taken."""
_NOTABLE_TILT_RAD = math.radians(10.0)  # shortens ranges by 1.5 %
_WORLD = {"map", "odom", "world", "earth", "ned", "enu"}


def base_frame_of(links: Collection[tuple[str, str]], vehicle_id: str, namespace: str = "") -> str:
    """Frame of a vehicle's body in a tree of frames: (parent, child), slashes or not.

    That called base_link, of the vehicle's name or namespace or the only one; else the only one
    that instruments hang from.
    """
    parents = {parent.strip("/") for parent, _ in links}
    children = {child.strip("/") for _, child in links}
    frames = parents | children
    tail = parts_of(namespace)[-1] or vehicle_id
    expected = [f"{tail}/base_link", f"{vehicle_id}/base_link", "base_link"]
    if found := [name for name in expected if name in frames]:
        return found[0]
    others = sorted(name for name in frames if parts_of(name)[-1] == "base_link")
    if not others:
        below_world = {c.strip("/") for p, c in links if _is_world(p)}
        roots = {name for name in parents if not _is_world(name)} - (children - below_world)
        own = {name for name in roots if parts_of(name)[0] in (tail, vehicle_id)}
        others = sorted(own or {name for name in roots if "/" not in name})
    return others[0] if len(others) == 1 else expected[0]


def _is_world(frame_id: str) -> bool:
    return bool(_WORLD & set(re.split("[^a-z]+", parts_of(frame_id)[-1].lower())))


class Mountings:
    """Where the instruments of a vehicle sit, as transforms tell it.

    Parameters
    ----------
    base_frame_id
        Frame of the vehicle's body.

    Attributes
    ----------
    unknown : dict[str, str]
        Frames that no transform leads from to the body -> kind of reading. They are taken to sit
        at its origin, with the axes that their message's definition says.
    taken_for : dict[str, tuple[str, str]]
        Such frames of a sonar or a DVL -> kind of reading, and the only frame that transforms
        have for one by its name: that is taken then.
    tilted : dict[str, float]
        Frames of sonars that point notably up or down -> by how much [rad].
    """

    def __init__(self, base_frame_id: str) -> None:
        self._base_frame_id = base_frame_id
        self._frames = StaticFrames()
        self._known: dict[tuple[type, str], FloatArray] = {}
        self._changes = MountingChanges()
        self.unknown: dict[str, str] = {}
        self.taken_for: dict[str, tuple[str, str]] = {}
        self.tilted: dict[str, float] = {}

    def add(self, event: TransformEvent) -> None:
        """Take a transform; one that was told before is replaced."""
        self._changes.note_transform(event.frame_id, event.child_frame_id, event.T_parent_child)
        self._frames.add(event.frame_id, event.child_frame_id, event.T_parent_child)
        self._known.clear()
        self.unknown.clear()
        self.taken_for.clear()

    @property
    def num_frames(self) -> int:
        """Frames whose place was told."""
        return len(self._frames)

    def is_known(self, event: Reading) -> bool:
        """Whether `of` would give what transforms tell, or was asked in vain before."""
        frame_id = _frame_of(event)
        if isinstance(event, _NEEDS_NONE) or self._is_base(frame_id):
            return True
        if frame_id in self.unknown or frame_id in self.taken_for:
            return True
        if (type(event), frame_id) in self._known:
            return True
        try:
            self._frames.lookup(self._base_frame_id, frame_id)
        except InvalidInputError:
            return False
        return True

    def of(self, event: Reading) -> FloatArray:
        """``T_base_sensor`` (4, 4) of the instrument that said this."""
        frame_id = _frame_of(event)
        if not isinstance(event, _NEEDS_NONE):
            self._changes.note_message(_topic_role(role_of(event)), frame_id)
        key = type(event), frame_id
        if key not in self._known:
            mounting = self._known[key] = self._mounting(event, frame_id)
            if role_of(event) == "sonar":
                forward = event.forward if isinstance(event, ImageEvent) else "x"
                if (tilt_rad := fan_tilt(mounting, forward)) > _NOTABLE_TILT_RAD:
                    self.tilted[frame_id] = tilt_rad
        return self._known[key]

    def _mounting(self, event: Reading, frame_id: str) -> FloatArray:
        if not frame_id.strip("/"):
            if (named := self._named_mounting(event, frame_id)) is not None:
                return named
            if role_of(event) == "sonar":  # of others the place counts little
                self.unknown[frame_id] = role_of(event)
            return usual_mounting(event)
        if self._is_base(frame_id):
            # A frame whose z is ahead is not the body's: its name was taken for the vehicle's.
            is_z_ahead = isinstance(event, ImageEvent) and event.forward == "z"
            return usual_mounting(event) if is_z_ahead else np.eye(4)
        try:
            return self._frames.lookup(self._base_frame_id, frame_id)
        except InvalidInputError:
            if (named := self._named_mounting(event, frame_id)) is not None:
                return named
            if not isinstance(event, _NEEDS_NONE):
                self.unknown[frame_id] = role_of(event)
            return usual_mounting(event)

    def _named_mounting(self, event: Reading, frame_id: str) -> FloatArray | None:
        """The mounting of the only sonar, or DVL, that transforms name; None if there is none."""
        word = role_of(event)
        if _is_world(frame_id):
            return None
        words = set(NAMES_OF_ROLES[_topic_role(word)]) if word in ("sonar", "dvl") else set()
        found = []
        for name in sorted(self._frames.names):
            if words & set(re.split("[^a-z0-9]+", parts_of(name)[-1].lower())):
                try:
                    found.append((name, self._frames.lookup(self._base_frame_id, name)))
                except InvalidInputError:
                    continue  # another vehicle's
        if len(found) != 1:
            return None
        name, mounting = found[0]
        self.taken_for[frame_id] = word, name
        return mounting

    def _is_base(self, frame_id: str) -> bool:
        return frame_id.strip("/") in ("", self._base_frame_id.strip("/"))

    def findings(self, vehicle_id: str) -> list[Finding]:
        """What to tell of frames that are unknown or move, and of sonars that are tilted."""

        def no_mounting(frame_id: str, word: str, told: str, severity: Severity) -> Finding:
            return Finding(
                "no_mounting",
                _topic_role(word),
                f"{_nowhere(frame_id)}; it is taken {told}",
                severity=severity,
                vehicle_id=vehicle_id,
            )

        unknown = [
            no_mounting(frame_id, word, "to sit at the origin, level and looking ahead", "warning")
            for frame_id, word in sorted(self.unknown.items())
        ]
        taken = [
            no_mounting(
                frame_id,
                word,
                f"for {name!r}, the only one named so",
                "warning" if frame_id else "info",
            )
            for frame_id, (word, name) in sorted(self.taken_for.items())
        ]
        tilted = [
            Finding(
                "sonar_tilted",
                "sonar",
                f"its frame {frame_id!r} points {math.degrees(tilt_rad):.0f} degrees up or down; "
                "each beam is projected by its middle, but how high an echo lies in the beam is "
                "not known, so that walls may be some per cent off: mount it level where a true "
                "map is wanted",
                vehicle_id=vehicle_id,
            )
            for frame_id, tilt_rad in sorted(self.tilted.items())
        ]
        strange = self.unknown.keys() | self.taken_for.keys()
        return unknown + taken + tilted + self._changes.findings(vehicle_id, strange, self._chain)

    def _chain(self, frame_id: str) -> list[str]:
        """Frames between an instrument's and the body, as they were taken."""
        try:
            return self._frames.chain(
                self._base_frame_id, self.taken_for.get(frame_id, ("", frame_id))[1]
            )
        except InvalidInputError:
            return []


def _topic_role(word: str) -> str:
    return "velocity" if word == "dvl" else word


def _nowhere(frame_id: str) -> str:
    if not frame_id:
        return "its messages name no frame (header.frame_id)"
    if _is_world(frame_id):
        return (
            f"its frame {frame_id!r} is not the vehicle's, which moves in it: have its driver "
            "publish what it hears in the sonar's own frame"
        )
    return f"no transform says where its frame {frame_id!r} sits"


def _frame_of(event: Reading) -> str:
    return event.child_frame_id if isinstance(event, PoseEvent) else event.frame_id


def role_of(reading: Reading) -> str:
    """What the instrument is to a mapper: sonar, dvl, imu, depth, odometry or fix."""
    match reading:
        case VelocityEvent():
            return "dvl"
        case ImuEvent():
            return "imu"
        case DepthEvent():
            return "depth"
        case PoseEvent():
            return "odometry"
        case FixEvent():
            return "fix"
    return "sonar"


def usual_mounting(event: Reading) -> FloatArray:
    """``T_base_sensor`` (4, 4) of an instrument at the origin that looks ahead, level, upright."""
    columns = np.eye(4)
    match event:
        case VelocityEvent(is_z_down=True):
            columns[:3, :3] = np.diag([1.0, -1.0, -1.0])
        case ImageEvent(forward="z"):
            columns[:3, :3] = [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]
    return columns
