"""What is wrong with a recording or with what became of it, in sentences."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["SEVERITIES", "WORDS", "Finding", "Severity"]

Severity = Literal["info", "warning", "error"]
SEVERITIES = ("info", "warning", "error")

WORDS = {"velocity": "dvl"}
"""What a role is called in text, where that is not the role's own name."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that somebody should know.

    Parameters
    ----------
    kind : short name of the cause in snake_case, such as ``imu_ned`` or ``no_heading``.
    role : the sensor that it is about (``sonar``, ``velocity``, ``imu``, ``depth``,
        ``odometry``, ``fix``, ``tf_static``), or "" for the recording as a whole.
    detail : one sentence: what was seen, and what to do about it.
    confidence : how sure, 0 to 1.
    severity : "info" is no reason to worry, "warning" may spoil the map, "error" forbids one.
    vehicle_id : whose; "" for all.
    """

    kind: str
    role: str
    detail: str
    confidence: float = 1.0
    severity: Severity = "warning"
    vehicle_id: str = ""

    def __post_init__(self) -> None:
        if not 0.0 <= self.confidence <= 1.0:
            raise InvalidInputError(f"confidence is {self.confidence}, expected 0 to 1")
        if self.severity not in SEVERITIES:
            raise InvalidInputError(
                f"severity is {self.severity!r}, expected one of {', '.join(SEVERITIES)}"
            )

    @property
    def sentence(self) -> str:
        """The detail, with whose it is and the sensor's word in front."""
        head = " ".join(p for p in (self.vehicle_id, WORDS.get(self.role, self.role)) if p)
        return f"{head}: {self.detail}" if head else self.detail

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)
