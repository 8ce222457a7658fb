"""Instruments that do not stay where they are, or of which several share a topic."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding

__all__ = ["MountingChanges"]

FloatArray = NDArray[np.float64]

_NOTABLE_RAD, _NOTABLE_M = math.radians(2.0), 0.1
"""Of a mounting: what a map shows."""
_MANY_CHANGES = 10
"""From one frame to another; a driver that was set up anew changes it once."""


class MountingChanges:
    """Watches transforms, and the frames that messages are in.

    Mountings are taken as fixed: that they are not must be told.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, str], FloatArray] = {}
        self._moved: dict[str, tuple[float, float]] = {}
        self._frames: dict[str, dict[str, None]] = {}
        self._last: dict[str, str] = {}
        self._num_changes: Counter[str] = Counter()

    def note_transform(self, parent: str, frame_id: str, T_parent_frame: FloatArray) -> None:
        """Compare a transform (4, 4) with the first one between the same frames."""
        name = frame_id.strip("/")
        first = self._first.setdefault((parent.strip("/"), name), T_parent_frame)
        turn_rad, way_m = _between(first, T_parent_frame)
        if turn_rad > _NOTABLE_RAD or way_m > _NOTABLE_M:
            known = self._moved.get(name, (0.0, 0.0))
            self._moved[name] = max(turn_rad, known[0]), max(way_m, known[1])

    def note_message(self, role: str, frame_id: str) -> None:
        """Take the frame of an instrument's message."""
        if self._last.get(role) != frame_id:
            self._num_changes[role] += role in self._last
            self._last[role] = frame_id
            self._frames.setdefault(role, {})[frame_id] = None

    def findings(
        self,
        vehicle_id: str,
        strange: Collection[str],
        chain_of: Callable[[str], Sequence[str]],
    ) -> list[Finding]:
        """What to tell of it.

        Parameters
        ----------
        strange : frames from which no transform leads to the body.
        chain_of : frames whose transforms lead from a frame to the body.
        """
        found = []
        for role, frames in self._frames.items():
            if self._num_changes[role] > _MANY_CHANGES and set(frames) & set(strange):
                names = " and ".join(repr(frame) for frame in frames)
                found.append(
                    Finding(
                        "several_frames",
                        role,
                        f"its messages come by turns from the frames {names}, which are not all "
                        "of this vehicle: several instruments, or vehicles, share the topic and "
                        "are mapped as one; record each on a topic of its own",
                        vehicle_id=vehicle_id,
                    )
                )
            for frame in frames if self._moved else ():
                moved = [self._moved[name] for name in chain_of(frame) if name in self._moved]
                if moved:
                    turn_rad, way_m = (max(column) for column in zip(*moved, strict=True))
                    found.append(
                        Finding(
                            "mounting_moves",
                            role,
                            f"transforms put its frame {frame!r} at places on the vehicle that "
                            f"differ by up to {math.degrees(turn_rad):.0f} degrees and "
                            f"{way_m:.2f} m: one of them is taken for the whole recording, and "
                            "what a unit saw that pans or tilts is drawn wrongly; fix it in "
                            "place, or map each of its positions as a recording of its own",
                            vehicle_id=vehicle_id,
                        )
                    )
        return found


def _between(T_parent_a: FloatArray, T_parent_b: FloatArray) -> tuple[float, float]:
    """Angle [rad] and distance [m] from one place to another."""
    cosine = 0.5 * (float(np.trace(T_parent_a[:3, :3].T @ T_parent_b[:3, :3])) - 1.0)
    turn_rad = math.acos(min(1.0, max(-1.0, cosine)))
    return turn_rad, float(np.linalg.norm(T_parent_b[:3, 3] - T_parent_a[:3, 3]))
