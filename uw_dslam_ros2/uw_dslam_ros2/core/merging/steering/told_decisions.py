"""What people decide on several vehicles, as one log that is the same everywhere.

A decision is told to the others with the round in which it was taken: who decides knows what was
decided before, and is a round later. So the order is no clock's; of those of one round, taken by
people who did not know of each other, what they are named after says which comes first. Each is
named by its content: it may come often, and in any order.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter, digest_of
from uw_dslam_ros2.core.merging.steering.decision_bytes import (
    NAME_BYTES,
    read_decision,
    write_decision,
)
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog

__all__ = ["ToldDecisions"]

_MAX_ROUND = 1_000_000
_MAX_TIMES = 255


class ToldDecisions:
    """All decisions of all vehicles, as they are after coding."""

    def __init__(self) -> None:
        self._rounds: dict[bytes, int] = {}  # by name
        self._contents: dict[bytes, bytes] = {}

    def take(self, data: bytes) -> None:
        """Hear a decision; `InvalidInputError` where the bytes are none."""
        reader = ByteReader(data)
        told_round = reader.bounded("round of a decision", 1, _MAX_ROUND)
        content = reader.rest
        read_decision(content[1:])
        self._keep(content, told_round)

    def settle(self, log: DecisionLog) -> tuple[DecisionLog, list[bytes]]:
        """Take the own log; returns that of all vehicles, and what the others must be told.

        An UNDO waits for what it undoes.

        Raises
        ------
        InvalidInputError
            If a decision of the log cannot be told; see `write_decision`.
        """
        told: list[bytes] = []
        names: dict[int, bytes] = {}
        times: Counter[bytes] = Counter()
        for decision in log:
            said = write_decision(decision, names.get(decision.undone, b""))
            # Who decides the same again within a millisecond means it.
            content = bytes([min(times[said], _MAX_TIMES)]) + said
            times[said] += 1
            name = names[decision.number] = digest_of(content, b"", NAME_BYTES)
            if name not in self._contents:
                self._keep(content, 1 + max(self._rounds.values(), default=0))
                writer = ByteWriter()
                writer.varint(self._rounds[name])
                told.append(bytes(writer) + content)
        return self._log(), told

    def _keep(self, content: bytes, told_round: int) -> None:
        name = digest_of(content, b"", NAME_BYTES)
        self._contents[name] = content
        # A log that was saved has numbers and no rounds: counted anew they may be others.
        self._rounds[name] = min(told_round, self._rounds.get(name, told_round))

    def _log(self) -> DecisionLog:
        numbers: dict[bytes, int] = {}
        decisions = []
        for name in sorted(self._contents, key=lambda name: (self._rounds[name], name)):
            decision, undone = read_decision(self._contents[name][1:])
            if undone and undone not in numbers:
                continue
            numbers[name] = len(numbers) + 1
            number_undone = numbers[undone] if undone else 0
            decisions.append(replace(decision, number=numbers[name], undone=number_undone))
        return DecisionLog(decisions)
