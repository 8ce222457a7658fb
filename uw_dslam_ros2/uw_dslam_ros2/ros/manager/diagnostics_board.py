"""What all nodes tell of themselves on /diagnostics, as a view shows it."""

from __future__ import annotations

import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

__all__ = ["DiagnosticsBoard"]

_LEVELS = {
    DiagnosticStatus.OK: "ok",
    DiagnosticStatus.WARN: "warning",
    DiagnosticStatus.ERROR: "error",
    DiagnosticStatus.STALE: "stale",
}
_MAX_NAMES = 500
_SENT = "sent bytes "  # begins the values of acoustic_link that count what it sent, by kind


class DiagnosticsBoard:
    """The newest status of each name; of acoustic links also the rate of their bytes."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, Any]] = {}
        self._heard_s: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, msg: DiagnosticArray, now_s: float) -> None:
        """Take what came; of too many names the one goes that was not heard for longest."""
        with self._lock:
            for status in msg.status:
                values = {pair.key: pair.value for pair in status.values}
                row = {
                    "name": status.name,
                    "level": _LEVELS.get(status.level, "error"),
                    "message": status.message,
                    "values": values,
                }
                sent = [value for key, value in values.items() if key.startswith(_SENT)]
                if sent:
                    row["sent_bytes"] = sum(float(value) for value in sent)
                    row["bits_per_s"] = self._rate(status.name, row["sent_bytes"], now_s)
                self._rows.pop(status.name, None)  # to the end
                self._rows[status.name], self._heard_s[status.name] = row, now_s
            while len(self._rows) > _MAX_NAMES:
                oldest = next(iter(self._rows))
                del self._rows[oldest], self._heard_s[oldest]

    def rows(self, now_s: float) -> list[dict[str, Any]]:
        """All by name, with the age of each."""
        with self._lock:
            return [
                {**self._rows[name], "age_s": round(now_s - self._heard_s[name], 1)}
                for name in sorted(self._rows)
            ]

    def troubles(self) -> list[str]:
        """A line for each that is not well."""
        with self._lock:
            return [
                f"{name}: {row['message']}"
                for name, row in sorted(self._rows.items())
                if row["level"] != "ok"
            ]

    def _rate(self, name: str, sent_bytes: float, now_s: float) -> float | None:
        """Since the status before; None for the first one, or after a restart."""
        before = self._rows.get(name, {}).get("sent_bytes")
        passed_s = now_s - self._heard_s.get(name, now_s)
        if before is None or passed_s <= 0.0 or sent_bytes < before:
            return None
        return round(8.0 * (sent_bytes - before) / passed_s, 1)
