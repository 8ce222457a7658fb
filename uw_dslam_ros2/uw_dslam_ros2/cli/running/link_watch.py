"""What the vehicles of a linked demo know, and what is missing until all know the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from uw_dslam_ros2.core.merging import SubmapState

__all__ = ["Known", "what_is_open"]

_OPEN = {
    "items to send": "to send",
    "items unconfirmed": "that another vehicle has not confirmed",
    "items lacking": "of others that have not come",
}
"""Of a link's diagnostics; at rest all are 0."""


@dataclass(slots=True)
class Known:
    """What one vehicle's manager knew when; times in recorded seconds."""

    vehicle: str
    num_submaps: list[tuple[float, int]] = field(default_factory=list)
    joined_s: dict[str, float] = field(default_factory=dict)
    revisions: dict[tuple[str, int, int], int] = field(default_factory=dict)

    def look(self, status: Any, now_s: float) -> None:
        """Note how much it knows, and whom it has joined."""
        if status is None:
            return
        self.revisions = {(s.vehicle_id, s.run_id, s.sequence): s.revision for s in status.submaps}
        if not self.num_submaps or self.num_submaps[-1][1] != len(self.revisions):
            self.num_submaps.append((now_s, len(self.revisions)))
        merged = {s.vehicle_id for s in status.submaps if s.state == SubmapState.MERGED}
        if self.vehicle in merged:
            for vehicle in sorted(merged - {self.vehicle}):
                self.joined_s.setdefault(vehicle, now_s)

    def facts(self, told: Mapping[str, str]) -> dict[str, Any]:
        """What the report says of the vehicle; `told` are its link's diagnostics."""
        sent: dict[str, dict[str, int]] = {}
        for name, value in told.items():
            for unit in ("packets", "bytes"):
                if (kind := name.removeprefix(f"sent {unit} ")) != name:
                    sent.setdefault(kind, {})[unit] = int(value)
        return {
            "num_submaps_known": len(self.revisions),
            "num_submaps_known_s": [[round(at_s, 1), num] for at_s, num in self.num_submaps],
            "joined_s": {name: round(at_s, 1) for name, at_s in self.joined_s.items()},
            "sent": sent,
            "received_packets": int(told.get("received packets", 0)),
            "received_bytes": int(told.get("received bytes", 0)),
            "repeated_packets": int(told.get("repairs", 0)),
            "duplicates": int(told.get("duplicates", 0)),
            "refused": {
                name.removeprefix("refused: "): int(value)
                for name, value in told.items()
                if name.startswith("refused: ")
            },
        }


def what_is_open(
    vehicles: Sequence[str],
    links: Sequence[Mapping[str, str]],
    managers: Sequence[Mapping[str, str]],
) -> list[str]:
    """What keeps all vehicles from having come to the same map for good, one sentence each.

    Parameters
    ----------
    vehicles
        Their names.
    links, managers
        Diagnostics of each one's nodes.
    """
    found = []
    for vehicle, link, manager in zip(vehicles, links, managers, strict=True):
        for name, text in _OPEN.items():
            if (num := link.get(name, "?")) != "0":
                found.append(f"the link of {vehicle} has {num} items {text}")
        if manager.get("is_settled") != "1":
            found.append(f"the queue of {vehicle} is still registering")
    if len({manager.get("map_digest") for manager in managers}) > 1:
        found.append("the vehicles' maps differ")
    return found
