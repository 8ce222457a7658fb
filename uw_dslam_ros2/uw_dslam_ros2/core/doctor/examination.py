"""What the doctor found of one vehicle, and what mends it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.findings import Finding

__all__ = ["Examination", "ScaleEstimate", "words_of"]


@dataclass(frozen=True, slots=True)
class ScaleEstimate:
    """How much farther the echoes move than navigation says: a ratio, and its sigma.

    ``by`` is the role that says how far: ``velocity`` or ``odometry``.
    """

    ratio: float
    sigma: float
    by: str


@dataclass(slots=True)
class Examination:
    """What was found, surest cause first, and the conventions that mend it."""

    findings: list[Finding] = field(default_factory=list)
    conventions: Conventions = field(default_factory=Conventions)
    num_ping_motions: int = 0
    num_turning_windows: int = 0
    """Spans in which turns of a sonar were compared."""
    is_turning: bool = False
    """Whether the sonar turns."""
    mended: set[str] = field(default_factory=set)
    """Kinds of findings that the conventions or the front end's settings mend."""
    sonar_changes: dict[str, str | float] = field(default_factory=dict)
    """Settings of the sonar's front end (`SonarConfig`) that mend what was found."""
    has_yaw: bool = True
    has_yaw_rate: bool = True
    is_velocity_judged: bool = False
    """Whether enough motions of the echoes lay within known velocities."""
    pixels: str = ""
    """What the sonar's images hold: compressed, amplitude, power, decibel; "": not known."""
    scale: ScaleEstimate | None = None
    """None where too little was seen, where a unit is wrong, or where the sonar is tilted."""
    vehicle_id: str = ""
    """Whose it is."""

    def add(self, finding: Finding, **changes: str | float | bool) -> None:
        """Name a cause, and what to change."""
        self.findings.append(finding)
        if changes:
            self.mended.add(finding.kind)
        self.conventions = Conventions(**(self.conventions.to_dict() | changes))

    def tell(
        self,
        kind: str,
        role: str,
        detail: str,
        confidence: float = 1.0,
        **changes: str | float | bool,
    ) -> None:
        """Name a cause of this vehicle; see `Finding` and `add`."""
        self.add(Finding(kind, role, detail, confidence, vehicle_id=self.vehicle_id), **changes)

    def put_first(self) -> None:
        """Name what was told last before all others, which may follow from it."""
        self.findings.insert(0, self.findings.pop())


def words_of(changes: Mapping[str, str | float | bool]) -> str:
    """Conventions as lines of settings, for a sentence."""
    words = {k: str(v).lower() if isinstance(v, bool) else v for k, v in changes.items()}
    return ", ".join(f"conventions.{name}: {value}" for name, value in words.items())
