"""The few registrations of a run that a report shows as pictures."""

from __future__ import annotations

from collections.abc import Sequence

from uw_dslam_ros2.core.merging import SubmapRecord
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.submap import Track
from uw_dslam_ros2.view.pairs import Pair, pair_of

__all__ = ["looks_of"]

_MAX_LOOKS = 6


def looks_of(
    answers: Sequence[tuple[Answer, bool]], records: Sequence[SubmapRecord]
) -> tuple[tuple[int, Pair], ...]:
    """Of each two runs the match that joins most, or the most probable of those refused.

    Those that hold come first; six in all.

    Parameters
    ----------
    answers
        And whether each holds; they are numbered from 1.
    records
        All submaps.
    """
    best: dict[frozenset[Track], tuple[bool, int, float, int, Answer]] = {}
    for number, (answer, is_used) in enumerate(answers, start=1):
        query = answer.query
        tracks = frozenset((query.source.reference.track, query.target.reference.track))
        if answer.T_target_source is None or not answer.is_finite or len(tracks) < 2:
            continue
        size = len(query.source.ids) * len(query.target.ids) if is_used else 0
        entry = (is_used, size, answer.probability, -number, answer)
        if tracks not in best or entry[:4] > best[tracks][:4]:
            best[tracks] = entry
    chosen = sorted(best.values(), key=lambda entry: entry[:4], reverse=True)[:_MAX_LOOKS]
    held = {record.submap.submap_id: record.submap for record in records}
    looks = []
    for *_, negative, answer in chosen:
        ids = (*answer.query.source.ids, *answer.query.target.ids)
        stored = {i: StoredSubmap.of(held[i], held[i].grid.values.size) for i in ids if i in held}
        assert answer.T_target_source is not None
        if len(stored) == len(set(ids)):
            looks.append((-negative, pair_of(answer.query, answer.T_target_source, stored)))
    return tuple(looks)
