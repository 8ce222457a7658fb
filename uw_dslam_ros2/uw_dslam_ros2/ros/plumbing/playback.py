"""When a recorded message is due: the clockwork of the bag player, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable

__all__ = ["Pacer"]

_MAX_BEHIND_S = 0.1
_POLL_S = 0.05


class Pacer:
    """Maps recorded time to a steady clock at a rate, with pauses.

    A stall is not made up for by a burst: whoever falls behind by more than a tenth of a second
    goes on from there.

    Parameters
    ----------
    rate : recorded seconds per second.
    clock : steady time [s].
    is_stopped : asked while waiting; True ends the wait.
    """

    def __init__(
        self, rate: float, clock: Callable[[], float], is_stopped: Callable[[], bool]
    ) -> None:
        self._rate = rate
        self._clock = clock
        self._is_stopped = is_stopped
        self._running = threading.Event()
        self._running.set()
        self._anchor: tuple[int, float] | None = None

    def restart(self) -> None:
        """Forget the anchor: the next message is due at once."""
        self._anchor = None

    def set_paused(self, is_paused: bool) -> None:
        """Stop or go on."""
        if is_paused:
            self._running.clear()
        else:
            self._anchor = None
            self._running.set()

    @property
    def is_paused(self) -> bool:
        """Whether time stands still."""
        return not self._running.is_set()

    def wait_for(self, stamp_ns: int, on_turn: Callable[[], None] = lambda: None) -> bool:
        """Wait until a message of `stamp_ns` is due; False when stopped.

        `on_turn` is called now and then while waiting.
        """
        while not self._is_stopped():
            if self.is_paused:
                self._running.wait(_POLL_S)
                self._anchor = None
                continue
            now_s = self._clock()
            anchor = self._anchor
            if anchor is None:
                self._anchor = (stamp_ns, now_s)
                return True
            due_s = anchor[1] + (stamp_ns - anchor[0]) * 1e-9 / self._rate
            if now_s >= due_s:
                if now_s - due_s > _MAX_BEHIND_S:
                    self._anchor = (stamp_ns, now_s)
                return True
            on_turn()
            # Waiting on an event that never comes ends sooner when the player is paused or
            # stopped.
            threading.Event().wait(min(due_s - now_s, _POLL_S))
        return False
