"""Tells while a mission runs which conventions its sensors do not follow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.feeding import SensorEvent
from uw_dslam_ros2.io.watching import ReadingWatch
from uw_dslam_ros2.ros.plumbing.worker import Worker

__all__ = ["ConventionWatch"]


class ConventionWatch:
    """Examines what a mapper is fed, in a thread of its own.

    Nothing is changed by what it finds: a map would tear where its conventions change.

    Parameters
    ----------
    tell : called once for each kind of finding, in that thread.
    on_error : called with what an examination raised.
    """

    def __init__(
        self,
        sonar: SonarConfig,
        vehicle_id: str,
        tell: Callable[[Finding], None],
        on_error: Callable[[Exception], None],
    ) -> None:
        self._watch = ReadingWatch(sonar, vehicle_id)
        self._worker = Worker("doctor", on_error)
        self._tell = tell
        self._found: dict[str, Finding] = {}

    def take(self, reading: SensorEvent, T_base_sensor: NDArray[np.float64]) -> None:
        """Look at a reading that is mapped."""
        if (examination := self._watch.take(reading, T_base_sensor)) is not None:
            self._worker.post(lambda: self._note(examination()))

    def _note(self, examined: Examination) -> None:
        for finding in examined.findings:
            if finding.severity != "info" and finding.kind not in self._found:
                self._found = self._found | {finding.kind: finding}
                self._tell(finding)

    @property
    def sentence(self) -> str:
        """All that was found; empty where nothing was."""
        return "; ".join(finding.sentence for finding in self._found.values())

    def close(self) -> None:
        """End after the examination at hand."""
        self._worker.close(timeout_s=5.0)
