"""Clocks of a recording: stamps that are zero, jump, or disagree, by the times of recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.stamp_fields import (
    finding_of_unit,
    in_unit,
    unit_of_fractions,
    why_useless,
)

__all__ = ["Gap", "StreamTimes", "corrected_clocks", "find_gaps", "gaps_at_the_ends"]

IntArray = NDArray[np.int64]

_SECOND_NS = 1_000_000_000
_JUMP_BACK_S = 1.0
"""Stamps of one sensor never go back by more, unless its clock is set."""
_JUMP_AHEAD_S = 5.0
"""They may go ahead by less where messages are held up, or by more than `_JUMP_BACK_S` where each
takes as long as the last."""
_STEADY_S = 0.05
_SAME_JUMP_S = 0.5
_MAX_DRIFT = 0.2
"""Share by which times of recording that were taken live may go slower or faster than stamps."""
_NEIGHBOURS = 5
"""A jump lasts: a single message that came late is none."""
_DISAGREE_S = 30.0
"""A sensor whose stamps lie behind by more has another clock; by less, it may only be slow."""
_AHEAD_S = 1.0
"""Nothing is recorded before it is measured: stamps cannot be ahead of those of the others."""
_MIN_GAP_S = 5.0
_GAP_PERIODS = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class StreamTimes:
    """Stamps (N,) and times of recording (N,) of one sensor's messages, in order of recording."""

    stamp_ns: IntArray
    recorded_ns: IntArray


@dataclass(frozen=True, slots=True)
class Gap:
    """A sensor's silence, from one message to the next, or to the end."""

    role: str
    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """How long."""
        return (self.end_ns - self.start_ns) * 1e-9


def corrected_clocks(
    streams: Mapping[str, StreamTimes],
) -> tuple[dict[str, IntArray], list[Finding]]:
    """Stamps (N,) [ns] of every sensor on one clock, and what was wrong with them.

    Stamps are left alone where nothing is wrong. A sensor without stamps gets the times of
    recording; clocks that jump are brought back; one that disagrees with the others is moved by
    the median difference. All of this is told.
    """
    streams = {role: times for role, times in streams.items() if len(times.stamp_ns)}
    findings: list[Finding] = []
    for role, times in streams.items():
        if (unit_ns := unit_of_fractions(times.stamp_ns)) != 1:
            streams[role] = replace(times, stamp_ns=in_unit(times.stamp_ns, unit_ns))
            findings.append(finding_of_unit(role, unit_ns))
    useless = {role: why_useless(times.stamp_ns) for role, times in streams.items()}
    without = {role for role, (kind, _) in useless.items() if kind}
    stamps = {r: t.stamp_ns.copy() for r, t in streams.items()}
    # A stamp of zero among others is a bad message, and says nothing of the clock.
    is_set = {role: times.stamp_ns > 0 for role, times in streams.items()}
    judged = {
        role: StreamTimes(times.stamp_ns[is_set[role]], times.recorded_ns[is_set[role]])
        for role, times in streams.items()
        if role not in without
    }
    mended = {role: times.stamp_ns.copy() for role, times in judged.items()}
    if judged:
        _mend_jumps(judged, mended, findings)
        _mend_offsets(judged, mended, findings)
    for role, stamp_ns in mended.items():
        stamps[role][is_set[role]] = stamp_ns
    delays = [_delay_ns(times, mended[role]) for role, times in judged.items()]
    for role in sorted(without):
        stamps[role] = streams[role].recorded_ns - (int(np.median(delays)) if delays else 0)
        findings.append(
            Finding(
                useless[role][0],
                role,
                f"its stamps {useless[role][1]}; the times of recording are used instead, which "
                "come late by an unknown delay: let the driver fill header.stamp",
            )
        )
    return stamps, findings


def _delay_ns(times: StreamTimes, stamp_ns: IntArray) -> int:
    return int(np.median(times.recorded_ns - stamp_ns))


def _mend_jumps(
    streams: Mapping[str, StreamTimes], stamps: dict[str, IntArray], findings: list[Finding]
) -> None:
    """Undo what the clocks were set by, in each stream from there on."""
    found = {role: _jumps(times) for role, times in streams.items()}
    sizes = np.array([size_ns for jumps in found.values() for _, size_ns in jumps], dtype=float)
    start_ns = min(int(times.recorded_ns[0]) for times in streams.values())
    told: dict[tuple[int, float], list[str]] = {}
    for role, jumps in found.items():
        for index, size_ns in jumps:
            # Sensors of one computer jump alike; their median is better than each by itself.
            alike = sizes[np.abs(sizes - size_ns) < _SAME_JUMP_S * _SECOND_NS]
            common_ns = int(np.median(alike))
            stamps[role][index:] -= common_ns
            at_s = (int(streams[role].recorded_ns[index]) - start_ns) * 1e-9
            key = next(
                (k for k in told if k[0] == common_ns and abs(k[1] - at_s) < 5.0),
                (common_ns, at_s),
            )
            told.setdefault(key, []).append(role)
    for (size_ns, at_s), roles in told.items():
        is_all = set(roles) == set(streams)
        way = "back" if size_ns < 0 else "forward"
        whose = "the clock was" if is_all else "its clock was"
        for role in [""] if is_all else sorted(set(roles)):
            findings.append(
                Finding(
                    "clock_jump",
                    role,
                    f"{whose} set {way} by {abs(size_ns) * 1e-9:.1f} s, {at_s:.0f} s into the "
                    "recording; later stamps are corrected by the times of recording",
                )
            )


def _jumps(times: StreamTimes) -> list[tuple[int, int]]:
    """Index of each message before which a clock was set, and by how much [ns]."""
    stamp_ns, recorded_ns = times.stamp_ns, times.recorded_ns
    step_ns = np.diff(stamp_ns)
    excess_ns = step_ns - np.diff(recorded_ns)
    is_back = (step_ns < -_JUMP_BACK_S * _SECOND_NS) & (excess_ns < -_JUMP_BACK_S * _SECOND_NS)
    is_steady = len(excess_ns) > 0 and np.median(np.abs(excess_ns)) < _STEADY_S * _SECOND_NS
    is_ahead = excess_ns > (_JUMP_BACK_S if is_steady else _JUMP_AHEAD_S) * _SECOND_NS
    ahead_ns = stamp_ns - recorded_ns
    others_ns = excess_ns[~(is_back | is_ahead)]
    span_ns = int(recorded_ns[-1] - recorded_ns[0])
    if abs(int(others_ns.sum())) > _MAX_DRIFT * span_ns:
        return []  # written at another pace than it was measured, by a converter
    jumps = []
    for index in np.flatnonzero(is_back | is_ahead) + 1:
        before = ahead_ns[max(0, index - _NEIGHBOURS) : index]
        after = ahead_ns[index : index + _NEIGHBOURS]
        size_ns = int(np.median(after) - np.median(before))
        if abs(size_ns) > _JUMP_BACK_S * _SECOND_NS:
            jumps.append((int(index), size_ns))
    return jumps


def _mend_offsets(
    streams: Mapping[str, StreamTimes], stamps: dict[str, IntArray], findings: list[Finding]
) -> None:
    """Move a sensor whose clock is not that of the others."""
    delays = {role: _delay_ns(times, stamps[role]) for role, times in streams.items()}
    near_ns = 2 * _SECOND_NS
    # The clock that most sensors share; the sonar's is the last to be asked.
    order = sorted(delays, key=lambda role: (role == "sonar", role))
    reference = max(
        order, key=lambda r: sum(abs(d - delays[r]) < near_ns for d in delays.values())
    )
    for role in order:
        behind_s = (delays[role] - delays[reference]) * 1e-9
        own_ns = streams[role].recorded_ns - stamps[role]
        is_steady = float(np.median(np.abs(own_ns - delays[role]))) * 1e-9 < _SAME_JUMP_S
        if -_AHEAD_S <= behind_s <= _DISAGREE_S or not is_steady:
            continue
        stamps[role] += delays[role] - delays[reference]
        way = "behind" if behind_s > 0.0 else "ahead of"
        findings.append(
            Finding(
                "clock_offset",
                role,
                f"its clock is {abs(behind_s):.1f} s {way} that of the others; its stamps are "
                "corrected by the times of recording: synchronise the clocks",
            )
        )


def find_gaps(stamps: Mapping[str, IntArray]) -> list[Gap]:
    """Silences of at least 5 s and 20 periods, those at the start and at the end included.

    `stamps` are those of each role, on one clock; what counts is the time in which the sonar
    (or, without one, any sensor) was recorded.
    """
    ordered = {role: np.sort(stamp_ns) for role, stamp_ns in stamps.items() if len(stamp_ns)}
    spans = [ordered["sonar"]] if "sonar" in ordered else list(ordered.values())
    if not spans:
        return []
    start_ns, end_ns = min(int(s[0]) for s in spans), max(int(s[-1]) for s in spans)
    gaps = []
    for role, stamp_ns in ordered.items():
        period_s = float(np.median(np.diff(stamp_ns))) * 1e-9 if len(stamp_ns) > 1 else 0.0
        least_ns = int(max(_MIN_GAP_S, _GAP_PERIODS * period_s) * _SECOND_NS)
        inside = stamp_ns[(stamp_ns > start_ns) & (stamp_ns < end_ns)]
        edges = np.concatenate([[start_ns], inside, [end_ns]])
        for index in np.flatnonzero(np.diff(edges) > least_ns):
            gaps.append(Gap(role, int(edges[index]), int(edges[index + 1])))
    return gaps


def gaps_at_the_ends(sonar_ns: IntArray, role: str, said_ns: IntArray) -> list[Gap]:
    """Silences of `find_gaps` before a sensor says something for the first time, and at the end.

    ``said_ns`` (K,) are the times of those of its messages that say something, ``sonar_ns`` (N,)
    those of the pings.
    """
    if not len(sonar_ns) or not len(said_ns):
        return []
    ends = int(sonar_ns.min()), int(sonar_ns.max())
    gaps = find_gaps({"sonar": sonar_ns, role: said_ns})
    return [g for g in gaps if g.role == role and (g.start_ns == ends[0] or g.end_ns == ends[1])]
