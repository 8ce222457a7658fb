"""A queue that rests, such as that of a saved session, as what a view shows and people change."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uw_dslam_ros2.core.errors import DataError, UwDslamError
from uw_dslam_ros2.core.merging import Decision, MapQueue
from uw_dslam_ros2.io.sessions.session import Session
from uw_dslam_ros2.view import registering
from uw_dslam_ros2.view.showing import Showing

__all__ = ["QueueSource"]

_WRITTEN_WITHIN_S = 120.0


class QueueSource:
    """A queue that changes only by what people decide.

    What a decision asks for is registered in a thread of its own, by the engine.

    Parameters
    ----------
    title
        For the page's head.
    queue
        That is shown.
    folder
        Session that decisions are saved in. It is taken, and read anew, with the first decision:
        who only looks is in nobody's way.
    write
        Called with a copy of the queue when all that a decision asked for is worked out: what
        else is made of it is made anew. Others may decide meanwhile; then it is called again.
    """

    def __init__(
        self,
        title: str,
        queue: MapQueue,
        folder: Path | None = None,
        write: Callable[[MapQueue], None] | None = None,
    ) -> None:
        self.title = title
        self._queue, self._folder, self._write = queue, folder, write
        self._session: Session | None = None
        self._showing = Showing.of_queue(queue)
        self._lock = threading.Lock()
        self._worker: threading.Thread | None = None
        self._trouble = ""
        self._doing = ""
        self._on_change: Callable[[], None] = lambda: None

    def showing(self) -> Showing:
        """The newest state."""
        return self._showing

    def status(self) -> dict[str, Any]:
        """What goes on."""
        is_busy = self._worker is not None and self._worker.is_alive()
        notes = [self._doing] if is_busy else []
        return {"is_live": False, "notes": [*notes, *filter(None, [self._trouble])]}

    def listen(self, on_change: Callable[[], None]) -> None:
        """Have something called when the queue has changed."""
        self._on_change = on_change

    def decide(self, decision: Decision) -> Decision:
        """Write it down, save it, and work out what follows.

        Raises
        ------
        InvalidInputError
            If it makes no sense.
        DataError
            If it cannot be saved; then it does not hold.
        """
        with self._lock:
            if self._folder is not None and self._session is None:
                self._take(self._folder)
            taken = self._queue.decide(
                dataclasses.replace(decision, stamp_ns=time.time_ns(), number=0)
            )
            try:
                self._save()
            except DataError:
                self._take_back()
                raise
            self._show()
            if self._worker is None or not self._worker.is_alive():
                self._worker = threading.Thread(target=self._settle, name="settle", daemon=True)
                self._worker.start()
        return taken

    def close(self) -> None:
        """Let others have the session; what is being written is written to its end."""
        worker = self._worker
        if worker is not None and self._write is not None:
            worker.join(_WRITTEN_WITHIN_S)
        with self._lock:
            if self._session is not None:
                self._session.close()
                self._session = None

    def _take(self, folder: Path) -> None:
        """Take the session for writing, as it is now."""
        session = Session(folder)
        queue = session.load()
        self._session = session
        if queue is not None:
            self._queue = queue

    def _take_back(self) -> None:
        """Go back to what is saved."""
        assert self._session is not None
        with contextlib.suppress(DataError):
            queue = self._session.load()
            if queue is not None:
                self._queue = queue

    def _save(self) -> None:
        if self._session is not None:
            self._session.save(self._queue)

    def _show(self) -> None:
        self._showing = Showing.of_queue(self._queue, self._showing)
        self._on_change()

    def _settle(self) -> None:
        """Work out all that is open, and what is made of it; others may decide meanwhile."""
        while True:
            self._doing = "registering what the decisions ask for …"
            with self._lock:
                requests = self._queue.next_requests(1)
                if not requests:
                    self._trouble = ""
                    try:
                        self._save()
                    except DataError as error:
                        self._trouble = str(error)
                    if self._write is None:
                        self._rest()
                        return
                    self._show()
                    num_decisions = self._queue.num_decisions
                    copy = MapQueue.from_state(self._queue.to_state())
            if not requests:
                self._write_files(copy)
                with self._lock:
                    if self._queue.num_decisions == num_decisions:
                        self._rest()
                        return
                continue
            (request,) = requests
            try:
                result = registering.register_by_engine(
                    request.source, request.target, request.prior
                )
            except UwDslamError as error:
                with self._lock:
                    self._queue.cancel_request(request.request_id)
                    self._trouble = str(error)
                    self._rest()
                return
            with self._lock:
                self._queue.add_result(request.request_id, result)

    def _rest(self) -> None:
        self._worker = None
        self._show()

    def _write_files(self, queue: MapQueue) -> None:
        assert self._write is not None
        self._doing = "writing map and report anew …"
        self._on_change()
        try:
            self._write(queue)
        except UwDslamError as error:
            self._trouble = str(error)
