"""Sensors that were heard, and are heard no more."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.findings import Severity

__all__ = ["SensorSilence"]

_SILENT_S, _LOST_S = 5.0, 30.0  # a silence that is a warning, and an error
_USUAL_PERIODS = 5.0


@dataclass(slots=True)
class _Heard:
    first_s: float
    last_s: float
    num: int = 1

    def silence_s(self, now_s: float) -> float:
        """Time since the last message; 0 as long as that is usual for this sensor."""
        period_s = (self.last_s - self.first_s) / max(1, self.num - 1)
        age_s = now_s - self.last_s
        return age_s if age_s > _USUAL_PERIODS * period_s else 0.0


class SensorSilence:
    """Notes when each sensor was heard, by a steady clock."""

    def __init__(self, now_s: float) -> None:
        self.last_s = now_s
        """When any sensor was heard, or this was made."""
        self._heard: dict[str, _Heard] = {}

    def hear(self, name: str, now_s: float) -> None:
        """A message of a sensor has come."""
        self.last_s = now_s
        heard = self._heard.get(name)
        if heard is None:
            self._heard[name] = _Heard(now_s, now_s)
        else:
            heard.last_s, heard.num = now_s, heard.num + 1

    def judge(self, now_s: float) -> tuple[Severity, str]:
        """How bad it is that sensors are silent, and which."""
        ages = {name: heard.silence_s(now_s) for name, heard in list(self._heard.items())}
        silent = {name: age_s for name, age_s in ages.items() if age_s > _SILENT_S}
        if not silent:
            return "info", ""
        text = "; ".join(f"{name}: no message for {age_s:.0f} s" for name, age_s in silent.items())
        return "error" if max(silent.values()) > _LOST_S else "warning", text
