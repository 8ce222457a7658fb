"""Signs of life for whoever started a node: systemd, or a container's health check."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

__all__ = ["Heartbeat"]

_FILE_PERIOD_S = 5.0


class Heartbeat:
    """Tells that a node is ready, and that it still spins; nothing where nobody wants to know.

    systemd says by ``NOTIFY_SOCKET`` where it listens and by ``WATCHDOG_USEC`` how often (unit
    ``Type=notify``, ``WatchdogSec=``). ``UW_ALIVE_FILE`` names a file that is touched every few
    seconds.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # A leading @ stands for an abstract socket.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        file = environment.get("UW_ALIVE_FILE", "")
        self._file = Path(file) if file else None
        period_s = int(environment.get("WATCHDOG_USEC") or 0) * 1e-6
        self._period_s = period_s / 3.0 if period_s > 0.0 else _FILE_PERIOD_S
        self._due_s = float("-inf")

    def is_ready(self) -> None:
        """The node is made."""
        self._notify("READY=1")

    def beat(self) -> None:
        """The node spins; may be called as often as one likes."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._period_s
        self._notify("WATCHDOG=1")
        if self._file is not None:
            with contextlib.suppress(OSError):  # whoever looks will see that it is old
                self._file.touch()

    def is_stopping(self) -> None:
        """The node was told to end."""
        self._notify("STOPPING=1")

    def _notify(self, text: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender,
        ):
            sender.connect(self._address)
            sender.send(text.encode())
