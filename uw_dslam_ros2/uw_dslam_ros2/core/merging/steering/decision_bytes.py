"""Decisions in some 50 bytes, to cross an acoustic link.

What comes back is rounded to millimetres, milliradians and milliseconds; coded again, it is the
same bytes.
"""

from __future__ import annotations

import math

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.merging.steering.decisions import Decision, DecisionKind
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import MAX_RUN_ID, SubmapId

__all__ = ["NAME_BYTES", "read_decision", "write_decision"]

NAME_BYTES = 6
"""By which an UNDO names what it undoes: a number in the log is not the same for all."""
_STAMP_NS = 1_000_000
_MAX_STAMP = 2**63 // _STAMP_NS
_STEP = 0.001  # [m], [rad]
_MAX_STEPS = 1 << 40
_TURN_BYTES = 3
_TURN = 1 << 8 * _TURN_BYTES
_MAX_TEXT_BYTES = 400
_MAX_SEQUENCE = 2**32 - 1
_OF_PAIRS = DecisionKind.FORBID, DecisionKind.CONFIRM, DecisionKind.REGISTER


def write_decision(decision: Decision, undone: bytes = b"") -> bytes:
    """All of a decision but its number.

    Parameters
    ----------
    decision
        Of any kind.
    undone
        For an UNDO: `NAME_BYTES` that name what it undoes.

    Raises
    ------
    InvalidInputError
        If a number is not finite, or too large to be meant.
    """
    kind, writer = decision.kind, ByteWriter()
    writer.fixed(2 * kind + decision.is_run, 1)
    writer.varint(decision.stamp_ns // _STAMP_NS)
    _write_text(writer, decision.who)
    for end in (decision.source, decision.target):
        if end is not None:
            _write_text(writer, end.vehicle_id)
            writer.varint(end.run_id)
            writer.varint(end.sequence)
    if decision.T_target_source is not None:
        _write_pose(writer, decision.T_target_source)
    if kind is DecisionKind.CONFIRM:
        _write_sizes(writer, decision.sigma_m, decision.sigma_rad)
    elif kind is DecisionKind.REGISTER:
        _write_sizes(writer, decision.half_width_m, decision.half_width_rad)
    elif kind is DecisionKind.FIX and decision.place is not None:
        for value in decision.point:
            writer.signed(_steps(value))
        _write_pose(writer, decision.place)
        _write_sizes(writer, decision.sigma_m, decision.sigma_rad)
        _write_text(writer, decision.earth_frame)
    elif kind is DecisionKind.UNDO:
        writer.raw(undone)
    return bytes(writer)


def read_decision(data: bytes) -> tuple[Decision, bytes]:
    """A decision without its number, and `NAME_BYTES` of what an UNDO undoes, else none.

    Raises
    ------
    InvalidInputError
        Where the bytes are no decision.
    """
    reader = ByteReader(data)
    head = reader.fixed(1)
    if head // 2 not in list(DecisionKind):
        raise InvalidInputError(f"decision.kind is {head // 2}, expected {list(DecisionKind)}")
    kind, is_run = DecisionKind(head // 2), bool(head % 2)
    stamp_ns = reader.bounded("decision.stamp [ms]", 0, _MAX_STAMP) * _STAMP_NS
    who = _read_text(reader)
    source = None if kind is DecisionKind.UNDO else _read_end(reader)
    target = _read_end(reader) if kind in _OF_PAIRS else None
    common = kind, who, stamp_ns, source, target, is_run
    undone = b""
    if kind is DecisionKind.CONFIRM:
        T, (metres, radians) = _read_pose(reader), _read_sizes(reader)
        decision = Decision(*common, T, sigma_m=metres, sigma_rad=radians)
    elif kind is DecisionKind.REGISTER:
        T, (metres, radians) = _read_pose(reader), _read_sizes(reader)
        decision = Decision(*common, T, half_width_m=metres, half_width_rad=radians)
    elif kind is DecisionKind.FIX:
        point = _read_steps(reader), _read_steps(reader)
        place, (metres, radians) = _read_pose(reader), _read_sizes(reader)
        decision = Decision(
            *common,
            sigma_m=metres,
            sigma_rad=radians,
            point=point,
            place=place,
            earth_frame=_read_text(reader),
        )
    elif kind is DecisionKind.UNDO:
        undone = reader.raw(NAME_BYTES)
        decision = Decision(*common, undone=1)
    else:
        decision = Decision(*common)
    if reader.rest:
        raise InvalidInputError(f"{len(reader.rest)} bytes follow the decision, expected none")
    return decision, undone


def _write_text(writer: ByteWriter, text: str) -> None:
    data = text.encode()
    if len(data) > _MAX_TEXT_BYTES:
        raise InvalidInputError(
            f"{text[:80]!r} has {len(data)} bytes, expected at most {_MAX_TEXT_BYTES}"
        )
    writer.varint(len(data))
    writer.raw(data)


def _read_text(reader: ByteReader) -> str:
    data = reader.raw(reader.bounded("length of a decision's text", 0, _MAX_TEXT_BYTES))
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"a decision's text is {data!r}, expected UTF-8") from error


def _read_end(reader: ByteReader) -> SubmapId:
    return SubmapId(
        _read_text(reader),
        reader.bounded("decision.run_id", 0, MAX_RUN_ID),
        reader.bounded("decision.sequence", 0, _MAX_SEQUENCE),
    )


def _steps(value: float) -> int:
    if not abs(value) < _MAX_STEPS * _STEP:
        raise InvalidInputError(
            f"a decision's number is {value}, expected less than {_MAX_STEPS * _STEP:g}"
        )
    return round(value / _STEP)


def _read_steps(reader: ByteReader) -> float:
    steps = reader.signed()
    if abs(steps) > _MAX_STEPS:
        raise InvalidInputError(
            f"a decision's number is {steps} steps, expected at most {_MAX_STEPS}"
        )
    return steps * _STEP


def _write_pose(writer: ByteWriter, T: SE2) -> None:
    writer.signed(_steps(T.x))
    writer.signed(_steps(T.y))
    writer.fixed(round(T.yaw / (2.0 * math.pi) * _TURN) % _TURN, _TURN_BYTES)


def _read_pose(reader: ByteReader) -> SE2:
    x, y = _read_steps(reader), _read_steps(reader)
    return SE2(x, y, reader.fixed(_TURN_BYTES) / _TURN * (2.0 * math.pi))


def _write_sizes(writer: ByteWriter, metres: float, radians: float) -> None:
    """Both above 0, and at least a step; a radian's infinity is 0."""
    writer.varint(max(1, _steps(metres)))
    writer.varint(0 if math.isinf(radians) else max(1, _steps(radians)))


def _read_sizes(reader: ByteReader) -> tuple[float, float]:
    metres = reader.bounded("size of a decision [mm]", 1, _MAX_STEPS) * _STEP
    radians = reader.bounded("size of a decision [mrad]", 0, _MAX_STEPS) * _STEP
    return metres, radians or math.inf
