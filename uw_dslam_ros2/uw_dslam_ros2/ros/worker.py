"""One thread that owns what is not thread-safe (a mapper, a queue), one job after the other.

Callbacks hand it work and return at once, so that messages keep flowing whatever a job takes.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

__all__ = ["Worker"]

T = TypeVar("T")


class Worker:
    """Runs jobs in the order of their posting.

    Parameters
    ----------
    name : the thread's name.
    on_error : called, in the thread, with what a posted job raised; the thread goes on.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None]) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._on_error = on_error
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, job: Callable[[], None]) -> None:
        """Have a job done, soon."""
        self._jobs.put(job)

    def call(self, job: Callable[[], T]) -> Future[T]:
        """Have a job done whose result or exception somebody waits for."""
        future: Future[T] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(job())
            except Exception as error:  # noqa: BLE001 (whoever waits gets it)
                future.set_exception(error)

        self._jobs.put(run)
        return future

    @property
    def num_waiting(self) -> int:
        """Jobs not begun."""
        return self._jobs.qsize()

    def close(self, timeout_s: float | None = None) -> None:
        """Finish the jobs posted so far, then end."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # noqa: BLE001 (a bad job must not end the thread)
                self._on_error(error)
