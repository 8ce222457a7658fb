"""Where the global frame is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.drawn.global_map import pinned_lattice
from uw_dslam_ros2.core.merging.graph.components import Component
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["GlobalFrame"]


class GlobalFrame:
    """The frame of one submap, whose cells are the lattice of the global map.

    Of ``anchor_vehicle``'s first submap, else of that vehicle's whose name comes first; among
    several groups of joined vehicles, of the largest group. It moves only while no vehicles are
    joined in it, or when a person says so; and once more where an earlier submap of the same run
    comes late, as over a link: else who got them in another order would have another map.

    Parameters
    ----------
    anchor_vehicle
        Name, or empty.
    resolution_m
        Of the lattice; 0: that of the submap.
    """

    def __init__(self, anchor_vehicle: str, resolution_m: float) -> None:
        self._anchor_vehicle, self._resolution_m = anchor_vehicle, resolution_m
        self.anchor: SubmapId | None = None
        self.lattice: GridSpec | None = None
        self.is_pinned = False  # for good: vehicles are joined in it
        self._notices: list[str] = []

    def take_notices(self) -> list[str]:
        """What a person should know of, since the last call: that it moved."""
        notices, self._notices = self._notices, []
        return notices

    def hold(self, submap_id: SubmapId, stored: StoredSubmap) -> bool:
        """Have it where a person wants it; True if that moves it."""
        before, self.is_pinned = self.anchor, True
        if submap_id == before:
            return False
        if before is not None:
            self._notices.append(
                f"the global frame is now that of {submap_id}, as a person decided; it was that "
                f"of {before}"
            )
        self._pin(submap_id, stored)
        return True

    def release(self) -> None:
        """No person wants it anywhere any more: the rule of the class decides."""
        self.anchor, self.is_pinned = None, False

    def settle(self, plan: Plan, submaps: Mapping[SubmapId, StoredSubmap], is_open: bool) -> bool:
        """Have the frame where the class says; True if that moves it.

        Parameters
        ----------
        plan
            In the frame as it is.
        submaps
            Those that it may be pinned to.
        is_open
            Whether answers are missing: what is joined now may come apart.
        """
        if self._begin_where_run_does(plan, submaps):
            return True
        placed = {i for part in plan.components for i in part}
        joined = [part for part in plan.components if len({i.track for i in part}) > 1]
        if self.anchor in placed:
            if self.is_pinned or any(self.anchor in part for part in joined):
                self.is_pinned |= not is_open
                return False
            if joined and is_open:
                return False
        return self.choose(submaps, joined)

    def choose(
        self, submaps: Mapping[SubmapId, StoredSubmap], joined: Sequence[Component] = ()
    ) -> bool:
        """Pin it to the first submap of the run that has to hold it; True if it moves."""
        starts: dict[Track, SubmapId] = {}
        for submap_id in sorted(submaps):
            starts.setdefault(submap_id.track, submap_id)
        by_name = sorted(
            starts, key=lambda t: (t.vehicle_id, submaps[starts[t]].submap.stamp_ns, t)
        )
        if self._anchor_vehicle:
            by_name = [track for track in by_name if track.vehicle_id == self._anchor_vehicle]
        elif joined:
            rank = {track: index for index, track in enumerate(by_name)}

            def worth(part: Component) -> tuple[int, int, int]:
                tracks = {i.track for i in part}
                return len(tracks), len(part), -min(rank[track] for track in tracks)

            largest = {i.track for i in max(joined, key=worth)}
            by_name = [track for track in by_name if track in largest]
        if not by_name or starts[by_name[0]] == self.anchor:
            return False
        start = starts[by_name[0]]
        if self.anchor is not None:
            self._notices.append(
                f"the global frame is now that of {start}; it was that of {self.anchor}, whose "
                "group goes on in a frame of its own"
            )
        self.is_pinned = False
        self._pin(start, submaps[start])
        return True

    def _begin_where_run_does(self, plan: Plan, submaps: Mapping[SubmapId, StoredSubmap]) -> bool:
        """Go over to an earlier submap of the anchor's run that has come late."""
        anchor = self.anchor
        own = next((part for part in plan.components if anchor in part), None)
        if anchor is None or own is None:
            return False
        first = min((i for i in submaps if i in own and i.track == anchor.track), default=anchor)
        if first >= anchor:
            return False
        self._notices.append(
            f"the global frame is now that of {first}, which came late; it was that of {anchor}"
        )
        self._pin(first, submaps[first])
        return True

    def _pin(self, submap_id: SubmapId, stored: StoredSubmap) -> None:
        spec = stored.submap.grid.spec
        self.anchor = submap_id
        self.lattice = pinned_lattice(spec, self._resolution_m or spec.resolution_m)
