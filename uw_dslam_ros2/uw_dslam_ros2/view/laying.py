"""Maps of single runs, for a person to lay one on another by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.view.pairs import map_picture
from uw_dslam_ros2.view.showing import Showing

__all__ = ["RunMap", "lay_out", "run_map"]


_MAX_SIDE = 500
"""Rows and columns of a picture: about what a screen shows of the whole of both maps."""


@dataclass(frozen=True, slots=True, eq=False)
class RunMap:
    """What one run of a vehicle saw, in the frame of its first submap."""

    reference: SubmapId
    occupancy: OccupancyMap

    def picture(self, layer: str) -> bytes:
        """PNG in the colour of a layer, ``source`` or ``target``; clear where nothing is known."""
        return map_picture(self.occupancy.values, layer, is_clear=True)

    def row(self) -> dict[str, Any]:
        """Where the picture lies."""
        spec = self.occupancy.spec
        return {
            "id": list(self.reference),
            "rows": spec.num_rows,
            "cols": spec.num_cols,
            "resolution_m": spec.resolution_m,
            "grid": spec.T_frame_grid.as_array().tolist(),
        }


def run_map(showing: Showing, name: str) -> RunMap:
    """The map of the run of a name.

    Raises
    ------
    InvalidInputError
        If there is no such run, or nothing in it.
    """
    records = _records(showing, name)
    first = records[0]
    T_first_group = first.T_component_submap.inverse()
    group = SubmapGroup.of(
        [showing.stored(r.submap.submap_id) for r in records],
        [T_first_group @ r.T_component_submap for r in records],
        0,
    )
    return RunMap(first.submap.submap_id, _coarse(showing.rendered(group)))


def lay_out(
    showing: Showing, source: str, target: str, number: int | None = None
) -> dict[str, Any]:
    """Both maps, and where the source lies at first.

    As registration `number` says; without one as the graph says; else middle on middle.
    """
    maps = run_map(showing, source), run_map(showing, target)
    if maps[0].reference.track == maps[1].reference.track:
        raise InvalidInputError(f"target is {target!r}, expected another run than the source")
    poses = {r.submap.submap_id: (r.component, r.T_component_submap) for r in showing.records}
    (group, T_source), (other, T_target) = (poses[m.reference] for m in maps)
    start = None
    if number is not None:
        start = _as_registered(showing, number, maps[0].reference, maps[1].reference)
    if start is None and group == other:
        start = T_target.inverse() @ T_source
    if start is None:
        middles = [m.occupancy.spec.centers_of(np.argwhere(m.occupancy.known)) for m in maps]
        shift = middles[1].mean(axis=0) - middles[0].mean(axis=0)
        start = SE2(float(shift[0]), float(shift[1]))
    return {
        "source": maps[0].row(),
        "target": maps[1].row(),
        "start": start.as_array().round(4).tolist(),
    }


def _coarse(occupancy: OccupancyMap) -> OccupancyMap:
    """The map in so few cells that a screen shows them; walls outlast the rest."""
    spec = occupancy.spec
    step = -(-max(spec.shape) // _MAX_SIDE)
    if step == 1:
        return occupancy
    rows, cols = -(-spec.num_rows // step), -(-spec.num_cols // step)
    even = np.full((rows * step, cols * step), UNKNOWN, np.int8)
    even[: spec.num_rows, : spec.num_cols] = occupancy.values
    values = even.reshape(rows, step, cols, step).max(axis=(1, 3))
    thick = cv2.dilate(values.astype(np.int16), np.ones((3, 3), np.uint8)).astype(np.int8)
    values = np.where(thick > 50, thick, values)
    return OccupancyMap(GridSpec(step * spec.resolution_m, rows, cols, spec.T_frame_grid), values)


def _as_registered(
    showing: Showing, number: int, source: SubmapId, target: SubmapId
) -> SE2 | None:
    """``T_target_source`` by an answer, if it is about these two runs."""
    answer = showing.answer(number)
    motion, query = answer.T_target_source, answer.query
    if motion is None:
        return None
    ends = query.source.reference, query.target.reference
    if (ends[0].track, ends[1].track) == (target.track, source.track):
        motion, ends = motion.inverse(), (ends[1], ends[0])
    if (ends[0].track, ends[1].track) != (source.track, target.track):
        return None
    poses = {r.submap.submap_id: r.T_component_submap for r in showing.records}
    return (
        poses[target].inverse()
        @ poses[ends[1]]
        @ motion
        @ poses[ends[0]].inverse()
        @ poses[source]
    )


def _records(showing: Showing, name: str) -> list[SubmapRecord]:
    own = [
        r
        for r in showing.records
        if showing.names.track(r.submap.submap_id.track) == name
        and r.state is not SubmapState.WITHDRAWN
    ]
    if not own:
        raise InvalidInputError(f"there is no run {name!r} with submaps in use")
    return own
