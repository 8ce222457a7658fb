"""Registrations side by side: a few run, a few wait, the rest is refused."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for_futures
from dataclasses import dataclass, field
from typing import Protocol

from uw_dslam_ros2.core.registration.result import Progress, RegistrationResult

__all__ = ["Job", "JobCounts", "RegistrationJobs", "Search"]


class Search(Protocol):
    """A registration that tells how it goes and can be told to stop."""

    def __call__(
        self, *, progress: Callable[[Progress], None], is_cancelled: Callable[[], bool]
    ) -> RegistrationResult:
        """Search; both functions are called now and then."""
        ...


@dataclass(slots=True, eq=False)
class Job:
    """One registration, running or waiting for its turn."""

    begun_s: float
    future: Future[RegistrationResult] = field(default_factory=Future)
    newest: Progress | None = None
    _cancelled: threading.Event = field(default_factory=threading.Event)

    def cancel(self) -> None:
        """Ask the search to stop; it does at its next look."""
        self._cancelled.set()

    @property
    def is_cancelled(self) -> bool:
        """Whether it was asked to stop."""
        return self._cancelled.is_set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end; False when it is not there yet."""
        return bool(wait_for_futures([self.future], timeout_s).done)

    def set_progress(self, progress: Progress) -> None:
        """Keep the newest state of the search."""
        self.newest = progress


@dataclass(frozen=True, slots=True)
class JobCounts:
    """How busy it is."""

    num_running: int
    num_waiting: int


class RegistrationJobs:
    """Threads that search: the kernels release Python's lock, so two searches use two cores.

    Parameters
    ----------
    max_parallel : searches at a time; 0 takes the number of cores.
    max_waiting : accepted beyond those; more are refused.
    """

    def __init__(self, max_parallel: int, max_waiting: int) -> None:
        self.max_parallel = max_parallel or len(os.sched_getaffinity(0))
        self.max_accepted = self.max_parallel + max_waiting
        self._threads = ThreadPoolExecutor(self.max_parallel, thread_name_prefix="search")
        self._lock = threading.Lock()
        self._jobs: set[Job] = set()
        self._is_closed = False

    def submit(self, search: Search) -> Job | None:
        """Begin a search, or None where too many were accepted already."""
        job = Job(time.monotonic())
        with self._lock:
            if self._is_closed or len(self._jobs) >= self.max_accepted:
                return None
            self._jobs.add(job)
        self._threads.submit(self._run, job, search)
        return job

    def _run(self, job: Job, search: Search) -> None:
        try:
            result = search(progress=job.set_progress, is_cancelled=lambda: job.is_cancelled)
        except BaseException as error:  # noqa: BLE001 (whoever waits for the job gets it)
            self._forget(job)
            job.future.set_exception(error)
        else:
            self._forget(job)
            job.future.set_result(result)

    def _forget(self, job: Job) -> None:
        with self._lock:
            self._jobs.discard(job)

    @property
    def counts(self) -> JobCounts:
        """How many run and wait."""
        with self._lock:
            num_running = min(len(self._jobs), self.max_parallel)
            return JobCounts(num_running, len(self._jobs) - num_running)

    def close(self) -> None:
        """Refuse new ones, stop those that run."""
        with self._lock:
            self._is_closed = True
            jobs = list(self._jobs)
        for job in jobs:
            job.cancel()
        self._threads.shutdown(wait=True)
