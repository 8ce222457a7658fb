"""What a mapper finds wrong with what it hears: counted, told, and what its health says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from rclpy.node import Node

from uw_dslam_ros2.core.findings import SEVERITIES, Finding, Severity
from uw_dslam_ros2.core.mapping import VehicleRuns
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.ros.plumbing.diagnostics import Report
from uw_dslam_ros2.ros.plumbing.frames import WARNING_PERIOD_S

__all__ = ["MapperTroubles"]


class MapperTroubles:
    """Logs each trouble, and keeps what stands in the diagnostics until something else does."""

    def __init__(self, node: Node, vehicle_id: str) -> None:
        self._logger, self._vehicle_id = node.get_logger(), vehicle_id
        self.counts: Counter[str] = Counter()
        """Of messages, for the diagnostics."""
        self._last = self._of_topics = self._of_mountings = ""
        self._told: set[str] = set()
        self._num_breaks_told = 0

    def complain(self, text: str) -> None:
        """A message that cannot be used."""
        self.counts["num_bad"] += 1
        self._last = text
        self._logger.error(text, throttle_duration_sec=WARNING_PERIOD_S)

    def complain_of(self, error: Exception) -> None:
        """Something that should not happen."""
        self.complain(f"{type(error).__name__}: {error}")

    def note_topics(self, text: str) -> None:
        """A topic that is missing, or of another type."""
        self._of_topics = text

    def note_finding(self, finding: Finding) -> None:
        """What looking for the sensors' topics has found."""
        if finding.severity != "info":
            self._of_topics = finding.sentence
            self._logger.warning(finding.sentence, throttle_duration_sec=WARNING_PERIOD_S)

    def note_convention(self, finding: Finding) -> None:
        """A convention that a sensor does not follow."""
        self._logger.warning(finding.sentence)

    def note_mountings(self, mountings: Mountings) -> None:
        """Say so where a frame's place is not known, or a sonar looks up or down."""
        findings = [
            finding
            for finding in mountings.findings(self._vehicle_id)
            if finding.severity != "info"
        ]
        self._of_mountings = findings[0].sentence if findings else ""
        for finding in findings:
            if finding.sentence not in self._told:
                self._told.add(finding.sentence)
                self._logger.warning(finding.sentence)

    def note_breaks(self, runs: VehicleRuns) -> bool:
        """Say so where a silence has begun a new run; whether anything has begun one."""
        new = runs.breaks[self._num_breaks_told :]
        for reason in new:
            if reason.role:
                what = "heading" if reason.role == "imu" else "velocity"
                self._last = (
                    f"no {what} for {reason.seconds:.0f} s: a new run begins; what was mapped "
                    "before is kept, and only registration joins the two"
                )
                self._logger.warning(self._last)
        self._num_breaks_told = len(runs.breaks)
        return bool(new)

    def report(
        self,
        values: Mapping[str, float | int | str],
        silence: tuple[Severity, str],
        convention: str,
        *,
        is_paused: bool,
    ) -> Report:
        """Health in a sentence.

        Parameters
        ----------
        values
            All that the diagnostics say in numbers, of them ``num_pings``.
        silence
            Whether sensors are silent, and which.
        convention
            What a sensor does not follow; empty: nothing is known.
        is_paused
            Whether pings are left out.
        """
        num_pings = values.get("num_pings", 0)
        problem = self._last or self._of_topics or self._of_mountings
        severity, silent = silence
        if convention:
            severity = max(severity, "warning", key=SEVERITIES.index)
            problem = convention
        if is_paused:
            return severity, silent or f"paused; {num_pings} pings mapped", dict(values)
        if not num_pings:
            text = problem or "no ping mapped yet"
            return max(severity, "warning", key=SEVERITIES.index), silent or text, dict(values)
        return severity, silent or problem or f"{num_pings} pings mapped", dict(values)
