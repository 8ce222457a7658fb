"""Child processes that end when their parent does: cleanly if they can, in any case."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from uw_dslam_ros2.core.errors import UwDslamError

__all__ = ["ChildError", "Children", "free_domain"]

_TAIL_LINES = 15
_PATIENCE_S = 10.0


def _hear_interrupts() -> None:
    """A shell lets what it runs with ``&`` ignore SIGINT, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class ChildError(UwDslamError):
    """A process ended that should not have."""


class Child:
    """One process with a session and a log of its own."""

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
        *,
        may_end: bool,
    ) -> None:
        self.name, self.log, self.may_end = name, log, may_end
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                arguments,
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                # Ctrl-C in the terminal must reach the parent alone, which ends us in order.
                start_new_session=True,
                preexec_fn=_hear_interrupts,
            )

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        return self._process.poll()

    def interrupt(self) -> None:
        """Ask once: a node that is asked twice dies in the middle of its clean-up."""
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def end(self, patience_s: float) -> None:
        """Wait; after that take it down with all that it started."""
        try:
            self._process.wait(max(0.0, patience_s))
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def tail(self) -> str:
        """Last lines of its log."""
        with self.log.open(errors="replace") as file:
            return "".join(deque(file, _TAIL_LINES))


class Children:
    """Starts processes and watches them; leaving the block ends all of them."""

    def __init__(self, environment: Mapping[str, str], logs: Path) -> None:
        self._environment, self._logs = environment, logs
        self._children: list[Child] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for child in self._children:
            child.interrupt()
        end_s = time.monotonic() + _PATIENCE_S
        for child in self._children:
            child.end(end_s - time.monotonic())

    def start(
        self, name: str, module: str, arguments: Sequence[str], *, may_end: bool = False
    ) -> Child:
        """Start the ``main`` of a module of ours with this interpreter.

        With `may_end` it may end by itself, with exit code 0.
        """
        code = f"import sys; from {module} import main; sys.exit(main())"
        command = [sys.executable, "-c", code, *arguments]
        log = self._logs / f"{name}.log"
        child = Child(name, command, self._environment, log, may_end=may_end)
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise if a process has ended that should not have.

        Raises
        ------
        ChildError
            With the process's name, the end of its log, and where the whole log is.
        """
        for child in self._children:
            code = child.poll()
            if code is None or (child.may_end and code == 0):
                continue
            raise ChildError(
                f"{child.name} ended with code {code}; its log, {child.log}, ends with\n"
                f"{child.tail()}"
            )


def free_domain() -> tuple[int, socket.socket]:
    """Choose a DDS domain that nobody of us uses on this machine, never the default 0.

    It is taken for as long as the returned socket is open.
    """
    # Which one it is does not matter to any result, so it need not be repeatable.
    candidates = random.sample(range(1, 101), 100)
    for domain_id in candidates:
        claim = socket.socket()
        try:
            claim.bind(("127.0.0.1", 21000 + domain_id))
        except OSError:
            claim.close()
            continue
        return domain_id, claim
    raise ChildError("every DDS domain from 1 to 100 is taken on this machine")
