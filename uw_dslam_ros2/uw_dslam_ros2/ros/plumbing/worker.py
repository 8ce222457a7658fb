"""One thread that owns what is not thread-safe (a mapper, a queue), one job after the other.

Callbacks hand it work and return at once, so that messages keep flowing whatever a job takes.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

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
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]
        self._jobs = queue.SimpleQueue()
        self._on_error = on_error
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, job: Callable[[], None]) -> None:
        """Have a job done, soon; what it raises goes to `on_error`."""
        self.call(job).add_done_callback(self._look_at)

    def call(self, job: Callable[[], T]) -> Future[T]:
        """Have a job done whose result or exception somebody waits for."""
        future: Future[T] = Future()
        self._jobs.put((future, job))
        return future

    @property
    def num_waiting(self) -> int:
        """Jobs not begun."""
        return self._jobs.qsize()

    def close(self, timeout_s: float | None = None) -> None:
        """End after the job at hand; those that wait are cancelled."""
        self._is_closing.set()
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _look_at(self, future: Future[Any]) -> None:
        if not future.cancelled() and isinstance(error := future.exception(), Exception):
            self._on_error(error)

    def _run(self) -> None:
        while (item := self._jobs.get()) is not None:
            future, job = item
            if self._is_closing.is_set():
                future.cancel()
            # A job that nobody waits for any more is not begun; one that has begun is ended.
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(job())
            except Exception as error:  # noqa: BLE001 (a bad job must not end the thread)
                future.set_exception(error)
