"""What a queue remembers as named records, and back."""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import Decision, DecisionKind, Fix, QueueState
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track
from uw_dslam_ros2.io.sessions.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.sessions.decisions import decision_from_plain, decision_to_plain
from uw_dslam_ros2.io.sessions.session_file import Record

__all__ = [
    "StateRecords",
    "first_version_state",
    "state_of",
    "submap_from_bytes",
    "submap_to_bytes",
]


class StateRecords:
    """Makes records; keeps the digests of submaps, as what did not change need not be hashed."""

    def __init__(self) -> None:
        self._digests: dict[SubmapId, tuple[Submap, bytes]] = {}

    def of(self, state: QueueState) -> dict[tuple[str, str], Record]:
        """Everything in a state, by kind and key."""
        records: dict[tuple[str, str], Record] = {}
        digests: dict[SubmapId, tuple[Submap, bytes]] = {}
        for submap in state.submaps:
            held = self._digests.get(submap.submap_id)
            digest = held[1] if held and held[0] is submap else _submap_digest(submap)
            digests[submap.submap_id] = submap, digest
            records["submap", json.dumps(submap.submap_id)] = Record(
                digest, partial(submap_to_bytes, submap)
            )
        self._digests = digests
        for decision in state.decisions:
            content = json.dumps(decision_to_plain(decision), allow_nan=False)
            records["decision", f"{decision.number:06d}"] = Record.of(content.encode())
        for answer in state.answers:
            digest = _answer_digest(answer)
            records["answer", digest.hex()] = Record(digest, partial(_answer_to_bytes, answer))
        for name, value in _meta(state).items():
            records["meta", name] = Record.of(json.dumps(value).encode())
        return records


def _meta(state: QueueState) -> dict[str, Any]:
    return {
        "anchor": state.anchor,
        "lattice": None if state.lattice is None else _spec_to_plain(state.lattice),
        "vehicles": state.tracks,
        "next_request_id": state.next_request_id,
        "standing": [[s.hex(), t.hex(), prior] for s, t, prior in sorted(state.standing)],
        "is_pinned": state.is_pinned,
        "fixes": [_fix_to_plain(fix) for fix in state.fixes],
    }


def state_of(records: dict[tuple[str, str], bytes], max_bytes: int) -> QueueState:
    """The state in records; submaps hold at most so many bytes."""
    of_kind: dict[str, dict[str, bytes]] = {}
    for (kind, key), content in sorted(records.items()):
        of_kind.setdefault(kind, {})[key] = content
    return _assembled(
        {name: json.loads(content) for name, content in of_kind.get("meta", {}).items()},
        list(of_kind.get("submap", {}).values()),
        [
            *_withdrawals([_submap_id(json.loads(key)) for key in of_kind.get("withdrawn", {})]),
            *(
                decision_from_plain(json.loads(content))
                for content in of_kind.get("decision", {}).values()
            ),
        ],
        [json.loads(content) for content in of_kind.get("answer", {}).values()],
        max_bytes,
    )


def first_version_state(connection: sqlite3.Connection, max_bytes: int) -> QueueState:
    """The state in the tables of the first format."""
    rows = connection.execute("SELECT name, value FROM meta").fetchall()
    submaps = connection.execute("SELECT content FROM submaps")
    withdrawn = connection.execute("SELECT * FROM withdrawn")
    answers = connection.execute("SELECT content FROM answers")
    return _assembled(
        {name.decode(): json.loads(value) for name, value in rows},
        [content for (content,) in submaps],
        _withdrawals([_submap_id((v.decode(), *numbers)) for v, *numbers in withdrawn]),
        [json.loads(content) for (content,) in answers],
        max_bytes,
    )


def _assembled(
    meta: dict[str, Any],
    submaps: list[bytes],
    decisions: list[Decision],
    answers: list[dict[str, Any]],
    max_bytes: int,
) -> QueueState:
    anchor, lattice = meta["anchor"], meta["lattice"]
    return QueueState(
        tuple(
            sorted(
                (submap_from_bytes(content, max_bytes) for content in submaps),
                key=lambda submap: submap.submap_id,
            )
        ),
        tuple(decisions),
        tuple(_answer_from_plain(answer) for answer in answers),
        None if anchor is None else _submap_id(anchor),
        None if lattice is None else _spec_from_plain(lattice),
        tuple(_track(plain) for plain in meta["vehicles"]),
        meta["next_request_id"],
        frozenset(
            (bytes.fromhex(source), bytes.fromhex(target), tuple(prior))
            for source, target, prior in meta["standing"]
        ),
        bool(meta.get("is_pinned", True)),
        tuple(_fix_from_plain(plain) for plain in meta.get("fixes", ())),
    )


def _fix_to_plain(fix: Fix) -> list[Any]:
    sigma_rad = fix.sigma_rad if math.isfinite(fix.sigma_rad) else None
    place = fix.place.as_array().tolist()
    return [fix.submap_id, fix.point, place, fix.sigma_m, sigma_rad, fix.earth_frame]


def _fix_from_plain(plain: list[Any]) -> Fix:
    submap_id, (x_m, y_m), place, sigma_m, sigma_rad, earth_frame = plain
    sigma_rad = math.inf if sigma_rad is None else sigma_rad
    return Fix(_submap_id(submap_id), (x_m, y_m), SE2(*place), sigma_m, sigma_rad, earth_frame)


def _withdrawals(submap_ids: list[SubmapId]) -> list[Decision]:
    """What a session from before there were decisions says of them."""
    return [
        Decision(DecisionKind.WITHDRAW, source=submap_id, number=number)
        for number, submap_id in enumerate(sorted(submap_ids), start=1)
    ]


def _submap_id(plain: Sequence[Any]) -> SubmapId:
    """A submap's key; without a run in sessions from before there were runs."""
    vehicle, *run, sequence = plain
    return SubmapId(vehicle, run[0] if run else 0, sequence)


def _track(plain: Any) -> Track:
    """A track; only the vehicle's name in sessions from before there were runs."""
    return Track(plain, 0) if isinstance(plain, str) else Track(*plain)


_SUBMAP_SCALARS = ("vehicle_id", "run_id", "sequence", "revision", "is_final", "stamp_ns")
_SUBMAP_ARRAYS = ("covariance", "points", "trajectory", "trajectory_stamp_ns")


def _submap_header(submap: Submap) -> bytes:
    header: dict[str, Any] = {name: getattr(submap, name) for name in _SUBMAP_SCALARS}
    header["T_odom_submap"] = submap.T_odom_submap.as_array().tolist()
    header["spec"] = _spec_to_plain(submap.grid.spec)
    return json.dumps(header, sort_keys=True).encode()


def _submap_digest(submap: Submap) -> bytes:
    hasher = hashlib.blake2b(_submap_header(submap), digest_size=16)
    for array in (submap.grid.values, *(getattr(submap, name) for name in _SUBMAP_ARRAYS)):
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.digest()


def submap_to_bytes(submap: Submap) -> bytes:
    """All of a submap."""
    arrays: dict[str, Any] = {n: np.asarray(getattr(submap, n)) for n in _SUBMAP_ARRAYS}
    header = np.frombuffer(_submap_header(submap), dtype=np.uint8)
    return arrays_to_bytes({"header": header, "values": submap.grid.values, **arrays})


def submap_from_bytes(content: bytes, max_bytes: int) -> Submap:
    """The submap of such bytes; `DataError` if it would take more than so many."""
    arrays = arrays_from_bytes(content, max_bytes)
    header = json.loads(arrays["header"].tobytes())
    grid = OccupancyMap(_spec_from_plain(header.pop("spec")), arrays["values"])
    T_odom_submap = SE2(*header.pop("T_odom_submap"))
    rest: dict[str, Any] = {name: arrays[name] for name in _SUBMAP_ARRAYS}
    return Submap(T_odom_submap=T_odom_submap, grid=grid, **header, **rest)


def _spec_to_plain(spec: GridSpec) -> list[Any]:
    return [spec.resolution_m, *spec.shape, spec.T_frame_grid.as_array().tolist()]


def _spec_from_plain(values: list[Any]) -> GridSpec:
    resolution_m, num_rows, num_cols, origin = values
    return GridSpec(resolution_m, num_rows, num_cols, SE2(*origin))


def _answer_digest(answer: Answer) -> bytes:
    source, target, prior = answer.query.key
    text = repr(prior).encode() + repr(_answer_to_plain(answer)).encode()
    return hashlib.blake2b(source + target + text, digest_size=16).digest()


def _answer_to_bytes(answer: Answer) -> bytes:
    return json.dumps(_answer_to_plain(answer)).encode()


def _answer_to_plain(answer: Answer) -> dict[str, Any]:
    prior, motion = answer.query.prior, answer.T_target_source
    return {
        "source": _group_to_plain(answer.query.source),
        "target": _group_to_plain(answer.query.target),
        "prior": prior
        and [
            prior.T_target_source.as_array().tolist(),
            prior.half_width_m,
            prior.half_width_rad,
        ],
        "verdict": int(answer.verdict),
        "reason": answer.reason,
        "T_target_source": motion and motion.as_array().tolist(),
        "covariance": answer.covariance.tolist(),
        "probability": answer.probability,
        "numbers": answer.numbers,
    }


def _answer_from_plain(plain: dict[str, Any]) -> Answer:
    prior, motion = plain["prior"], plain["T_target_source"]
    query = Query(
        _group_from_plain(plain["source"]),
        _group_from_plain(plain["target"]),
        None if prior is None else PriorWindow(SE2(*prior[0]), prior[1], prior[2]),
    )
    return Answer(
        query,
        Verdict(plain["verdict"]),
        plain["reason"],
        None if motion is None else SE2(*motion),
        np.array(plain["covariance"], dtype=np.float64),
        plain["probability"],
        plain["numbers"],
    )


def _group_to_plain(group: SubmapGroup) -> dict[str, Any]:
    members = [[*i, *T.as_array().tolist()] for i, T in group.T_reference_submap.items()]
    return {"reference": group.reference, "members": members, "key": group.key.hex()}


def _group_from_plain(plain: dict[str, Any]) -> SubmapGroup:
    members: dict[SubmapId, SE2] = {}
    for *name, x, y, yaw in plain["members"]:
        members[_submap_id(name)] = SE2(x, y, yaw)
    reference = _submap_id(plain["reference"])
    return SubmapGroup(reference, members, bytes.fromhex(plain["key"]))
