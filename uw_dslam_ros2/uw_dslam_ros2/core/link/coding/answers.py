"""Answers of registrations in some 25 bytes, so that a question need be searched only once.

A question is named by a digest of both maps and the window that was asked for, so that an answer
holds for the layers it was searched on and for no others. Whoever searches uses the answer as it
is after coding, too: the last digits of two processors do not matter.
"""

from __future__ import annotations

import hashlib
import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["AnswerExchange", "decode_answer", "encode_answer", "question_digest"]

_DIGEST_BYTES = 6
_POSITION_M = 0.001
_TURN = 1 << 20
_MAX_STEPS = 1_000_000_000


def question_digest(
    source: OccupancyMap, target: OccupancyMap, prior: PriorWindow | None = None
) -> bytes:
    """Name a question by its content (6 bytes)."""
    hasher = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for occupancy in (source, target):
        spec = occupancy.spec
        # To a tenth of a millimetre: two processors agree on that.
        place = np.rint(np.array([spec.resolution_m, *spec.T_frame_grid.as_array()]) * 1e4).astype(
            np.int64
        )
        hasher.update(place.tobytes() + repr(spec.shape).encode() + occupancy.values.tobytes())
    if prior is not None:
        window = [*prior.T_target_source.as_array(), prior.half_width_m, prior.half_width_rad]
        hasher.update(np.rint(np.array(window) * 1e4).astype(np.int64).tobytes())
    return hasher.digest()


class Judged(Protocol):
    """What is told of an answer: a `RegistrationResult` has it, and what a queue keeps of one."""

    @property
    def verdict(self) -> Verdict: ...

    @property
    def T_target_source(self) -> SE2 | None: ...  # noqa: N802 (notation of motions)

    @property
    def covariance(self) -> NDArray[np.float64]: ...

    @property
    def probability(self) -> float: ...


def encode_answer(question: bytes, result: Judged) -> bytes:
    """An answer; of one without a pose, or whose numbers are not finite, only the verdict."""
    writer = ByteWriter()
    writer.raw(question)
    T = result.T_target_source
    is_posed = T is not None and bool(np.isfinite(result.covariance).all())
    writer.fixed(2 * int(result.verdict) + is_posed, 1)
    if T is None or not is_posed:
        return bytes(writer)
    probability = result.probability if math.isfinite(result.probability) else 0.0
    # Never more probable than it was.
    writer.fixed(math.floor(255.0 * min(1.0, max(0.0, probability)) + 1e-9), 1)
    writer.signed(round(T.x / _POSITION_M))
    writer.signed(round(T.y / _POSITION_M))
    writer.fixed(round(T.yaw / (2.0 * math.pi) * _TURN) % _TURN, 3)
    writer.covariance(np.asarray(result.covariance, dtype=np.float64))
    return bytes(writer)


def decode_answer(data: bytes) -> tuple[bytes, RegistrationResult]:
    """Question and result; raises `InvalidInputError` where the bytes are no answer."""
    reader = ByteReader(data)
    question, head = reader.raw(_DIGEST_BYTES), reader.fixed(1)
    if head // 2 not in list(Verdict):
        raise InvalidInputError(f"verdict of an answer is {head // 2}, expected {list(Verdict)}")
    verdict = Verdict(head // 2)
    if head % 2 == 0:
        if verdict is Verdict.ACCEPTED:
            raise InvalidInputError("an accepted answer has no pose")
        return question, RegistrationResult.refused(verdict, _reason(verdict))
    probability = reader.fixed(1) / 255.0
    x, y = reader.signed(), reader.signed()
    if max(abs(x), abs(y)) > _MAX_STEPS:
        raise InvalidInputError(f"an answer's pose is {x}, {y} mm, expected below {_MAX_STEPS}")
    T = SE2(x * _POSITION_M, y * _POSITION_M, reader.fixed(3) / _TURN * (2.0 * math.pi))
    covariance = reader.covariance()
    if reader.rest:
        raise InvalidInputError(f"{len(reader.rest)} bytes follow the answer, expected none")
    return question, RegistrationResult(
        verdict=verdict,
        reason=_reason(verdict),
        T_target_source=T,
        covariance=covariance,
        probability=probability,
        score=math.nan,
        lower_bound=0.0,
        upper_bound=1.0,
        is_certified=False,
        num_boxes=0,
        seconds=math.nan,
        overlap=math.nan,
        conflict_ratio=math.nan,
        inlier_ratio=math.nan,
        num_source_points=0,
        num_target_points=0,
    )


def _reason(verdict: Verdict) -> str:
    return f"shared over the link: {verdict.name.lower().replace('_', ' ')}"


class AnswerExchange:
    """Answers by question: own ones as they are after coding, and those that others have sent.

    Of two answers to one question the one with the smaller bytes holds, whichever came first, so
    that all who have heard both agree.
    """

    def __init__(self) -> None:
        self._answers: dict[bytes, bytes] = {}

    def take(self, data: bytes) -> None:
        """Hear an answer; raises `InvalidInputError` where it is none."""
        question, _ = decode_answer(data)
        self._answers[question] = min(data, self._answers.get(question, data))

    def find(self, question: bytes) -> RegistrationResult | None:
        """The answer, if somebody has told it."""
        data = self._answers.get(question)
        return None if data is None else decode_answer(data)[1]

    def settle(self, question: bytes, result: RegistrationResult) -> RegistrationResult:
        """Keep an own answer; returns what all who hear of it will use."""
        self.take(encode_answer(question, result))
        return decode_answer(self._answers[question])[1]

    def data(self, question: bytes) -> bytes:
        """The answer's bytes, for `AcousticLink.add_answer`."""
        return self._answers[question]
