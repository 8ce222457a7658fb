"""What is in a mapper's open submap, in a file that is added to while it grows.

A process that is killed loses what came after the last addition. Each addition has a checksum;
one that was cut off is left out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.mapping.mapper_state import MapperState, SectionState
from uw_dslam_ros2.core.navigation import FilterState
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.sessions.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.sessions.ping_arrays import arrays_of_pings, pings_of_arrays

__all__ = ["OpenSubmapFile"]

_MAX_BYTES = 1 << 26
"""Of one addition."""
_HEAD_BYTES, _DIGEST_BYTES = 4, 16
_NONE_NS = -1
_Arrays = dict[str, NDArray[Any]]


class OpenSubmapFile:
    """Keeps the state of one mapper at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._key: tuple[int, int] | None = None
        self._counts = 0, 0, 0

    def write(
        self, mapper: VehicleMapper, pings: Mapping[SubmapId, Sequence[DrawnPing]], setup: bytes
    ) -> None:
        """Add what is new; see `KeptRuns.save_open`."""
        num_poses, num_echoes, num_pings = self._counts
        state = mapper.state(num_poses, num_echoes)
        if state is None:
            return
        is_new = self._key != (state.run_id, state.sequence)
        if is_new:
            self._counts = num_poses, num_echoes, num_pings = 0, 0, 0
            state = mapper.state()
            assert state is not None
        own = pings.get(SubmapId(mapper.vehicle_id, state.run_id, state.sequence), ())
        if len(own) != state.section.num_drawn:
            self.remove()  # no more pings are kept, and without them there is no grid
            return
        arrays = _arrays_of_state(state) | {
            f"ping_{name}": array for name, array in arrays_of_pings(own[num_pings:]).items()
        }
        content = setup + arrays_to_bytes(arrays)
        addition = len(content).to_bytes(_HEAD_BYTES, "little") + _digest(content) + content
        try:
            # No wait for the disk: it is for a process that is killed, each second anew.
            if is_new:
                beside = self._path.with_name(f".{self._path.name}.tmp")
                beside.write_bytes(addition)
                beside.replace(self._path)
            else:
                with self._path.open("ab") as file:
                    file.write(addition)
        except OSError as error:
            self._key = None  # it may end within an addition
            raise DataError(f"cannot keep what is mapped in {self._path}: {error}") from error
        self._key = state.run_id, state.sequence
        num_poses += len(state.section.stamps_ns)
        self._counts = num_poses, mapper.num_echoes, len(own)

    def read(self, setup: bytes) -> tuple[MapperState, list[DrawnPing]] | None:
        """State, and the pings in the open submap; None where there is nothing to go on with."""
        states: list[MapperState] = []
        pings: list[DrawnPing] = []
        try:
            for content in _additions(self._path.read_bytes()):
                if content[: len(setup)] != setup:
                    raise DataError(
                        "it is of a mapper with other settings: what was in its open submap is "
                        "lost"
                    )
                arrays = arrays_from_bytes(content[len(setup) :], _MAX_BYTES)
                states.append(_state_of_arrays(arrays))
                pings += pings_of_arrays(
                    {n.removeprefix("ping_"): a for n, a in arrays.items() if n[:5] == "ping_"}
                )
        except FileNotFoundError:
            return None
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"cannot read {self._path}: {error}") from error
        return (_joined(states), pings) if states else None

    def remove(self) -> None:
        """Keep nothing; `write` begins anew."""
        self._key = None
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(f"cannot remove {self._path}: {error}") from error


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


def _additions(content: bytes) -> Iterator[bytes]:
    """All up to the first that is not whole."""
    at = 0
    while at < len(content):
        start = at + _HEAD_BYTES + _DIGEST_BYTES
        end = start + int.from_bytes(content[at : at + _HEAD_BYTES], "little")
        own = content[start:end]
        if len(own) < end - start or _digest(own) != content[at + _HEAD_BYTES : start]:
            return
        yield own
        at = end


def _joined(states: Sequence[MapperState]) -> MapperState:
    """The last one, with all of the open submap."""
    last, parts = states[-1], [state.section for state in states]
    whole = SectionState(
        last.section.num_pings,
        last.section.num_drawn,
        np.vstack([part.trajectory for part in parts]),
        np.concatenate([part.stamps_ns for part in parts]),
        np.vstack([part.points for part in parts]),
        np.concatenate([part.weight for part in parts]),
    )
    return dataclasses.replace(last, section=whole)


def _arrays_of_state(state: MapperState) -> _Arrays:
    section = state.section
    velocity_ns = _NONE_NS if state.velocity_ns is None else state.velocity_ns
    numbers = [state.run_id, state.last_ping_ns, velocity_ns, section.num_pings, section.num_drawn]
    arrays: _Arrays = {
        "numbers": np.array(numbers, np.int64),
        "beamwidth_rad": np.array(state.beamwidth_rad),
        "T_odom_submap": state.T_odom_submap,
        "covariance": state.covariance,
        "trajectory": section.trajectory,
        "stamps_ns": section.stamps_ns,
        "points": section.points,
        "weight": section.weight,
    }
    for name in ("navigation", "dead_reckoning"):
        held: FilterState | None = getattr(state, name)
        if held is not None:
            zero_rad = math.nan if held.zero_rad is None else held.zero_rad
            arrays[f"{name}_ns"] = np.array(held.stamp_ns, np.int64)
            arrays[f"{name}_zero_rad"] = np.array(zero_rad)
            arrays[f"{name}_mean"], arrays[f"{name}_covariance"] = held.mean, held.covariance
    return arrays


def _state_of_arrays(arrays: _Arrays) -> MapperState:
    run_id, last_ping_ns, velocity_ns, num_pings, num_drawn = arrays["numbers"].tolist()
    filters: dict[str, FilterState | None] = {"navigation": None, "dead_reckoning": None}
    for name in filters:
        if f"{name}_ns" in arrays:
            zero_rad = float(arrays[f"{name}_zero_rad"])
            filters[name] = FilterState(
                int(arrays[f"{name}_ns"]),
                arrays[f"{name}_mean"],
                arrays[f"{name}_covariance"],
                None if math.isnan(zero_rad) else zero_rad,
            )
    navigation = filters["navigation"]
    if navigation is None:
        raise ValueError("it has no navigation")
    return MapperState(
        run_id,
        float(arrays["beamwidth_rad"]),
        last_ping_ns,
        None if velocity_ns == _NONE_NS else velocity_ns,
        navigation,
        filters["dead_reckoning"],
        arrays["T_odom_submap"],
        arrays["covariance"],
        SectionState(
            num_pings,
            num_drawn,
            *(arrays[name] for name in ("trajectory", "stamps_ns", "points", "weight")),
        ),
    )
