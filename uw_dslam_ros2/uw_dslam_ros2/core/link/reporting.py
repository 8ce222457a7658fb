"""When a vehicle tells the others what has come, and how much of it fits into a packet."""

from __future__ import annotations

import dataclasses

from uw_dslam_ros2.core.link.coding.items import PeerReport, Status
from uw_dslam_ros2.core.link.transport.packets import bundled
from uw_dslam_ros2.core.link.types import LinkConfig

__all__ = ["Reporting", "fitted"]

_PACKETS_PER_STATUS = 16  # between two reports while there is something else to send
_HASTE = 0.15  # who has nothing else to say reports that much sooner
_MAX_UNANSWERED = 10


class Reporting:
    """Counts what has come since the last report.

    Parameters
    ----------
    config
        How often, at most and at least.
    """

    def __init__(self, config: LinkConfig) -> None:
        self.num_news = 0
        self.num_reports = 0
        self._config = config
        self._last_s = -1e9
        self._num_unanswered = 0  # reports since there was anything new
        self._num_packets = _PACKETS_PER_STATUS  # since the last report alone

    def is_due(self, now_s: float, *, is_idle: bool, is_complete: bool, is_unheard: bool) -> bool:
        """Whether to report now.

        Parameters
        ----------
        now_s
            Now.
        is_idle
            There is nothing else to send.
        is_complete
            All that the others are known to have said is here.
        is_unheard
            Somebody has not confirmed all that was sent.
        """
        since_s, wait_s = now_s - self._last_s, self._config.status_s
        if not is_idle:
            # Turns that items wait for are not spent on reports alone.
            is_time = self._num_packets >= _PACKETS_PER_STATUS
            return is_time and (self.num_news > 0 or not is_complete)
        if self.num_news and since_s >= _HASTE * wait_s:
            return True
        # A report or the last of what was sent may have been lost.
        if is_unheard or not is_complete:
            # Soon once more, then ever more rarely: who does not answer may be far away.
            wait_s *= _HASTE * 2.0**self._num_unanswered
            return since_s >= min(wait_s, self._config.heartbeat_s)
        return since_s >= self._config.heartbeat_s

    @property
    def is_turn(self) -> bool:
        """Whether something else has gone out since the last report."""
        return self._num_packets > 0

    def told(self, now_s: float) -> None:
        """Note that a report goes out."""
        is_old = self.num_news == 0
        self._num_unanswered = min(self._num_unanswered + 1, _MAX_UNANSWERED) if is_old else 0
        self.num_news, self._last_s = 0, now_s
        self.num_reports += 1

    def sent(self, *, is_report: bool) -> None:
        """Note a packet, which held a report and nothing else or not."""
        self._num_packets = 0 if is_report else self._num_packets + 1


def fitted(status: Status, room: int) -> bytes:
    """A report as a note that fits into so many bytes, with as much in it as does."""
    while len(bundled([status.pack()])) > room:
        status = _shortened(status)
    return status.pack()


def _shortened(status: Status) -> Status:
    """With a little less about the one of whom most is said."""
    longest = max(status.peers, key=lambda sender: len(status.peers[sender].lacking), default=None)
    if longest is None or not status.peers[longest].lacking:
        fewer = dict(list(status.peers.items())[:-1])
        return dataclasses.replace(
            status, voids=status.voids[:-1], peers=fewer, is_cut=bool(status.peers)
        )
    report = status.peers[longest]
    short = PeerReport(report.epoch, report.base, report.lacking[:-1], True)
    return dataclasses.replace(status, peers=status.peers | {longest: short})
