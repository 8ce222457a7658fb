"""What people decided, for reports."""

from __future__ import annotations

import datetime
from dataclasses import dataclass

from uw_dslam_ros2.core.merging import DecisionRecord
from uw_dslam_ros2.core.run_names import RunNames

__all__ = ["DecisionRow"]


@dataclass(frozen=True, slots=True)
class DecisionRow:
    """What a person decided, as it is listed; ``when`` is UTC, empty where it is not known."""

    number: int
    who: str
    when: str
    kind: str
    what: str
    is_in_force: bool
    remark: str

    @classmethod
    def of(cls, record: DecisionRecord, names: RunNames) -> DecisionRow:
        """Put it into words."""
        decision = record.decision
        ends = [end for end in (decision.source, decision.target) if end is not None]
        shown = [
            f"all of {names.track(end.track)}" if decision.is_run else names.submap(end)
            for end in ends
        ]
        if decision.undone:
            shown = [f"decision {decision.undone}"]
        when = ""
        if decision.stamp_ns:
            moment = datetime.datetime.fromtimestamp(decision.stamp_ns // 10**9, datetime.UTC)
            when = f"{moment:%Y-%m-%d %H:%M:%S}"
        return cls(
            decision.number,
            decision.who,
            when,
            decision.kind.name,
            ", ".join(shown),
            record.is_in_force,
            names.in_text(record.remark),
        )
