"""Keeps on disk what a mapper has mapped, so that its run outlives the process."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.sessions.folder_lock import SessionInUseError
from uw_dslam_ros2.io.sessions.kept_runs import KeptRuns, ResumedRun

__all__ = ["RunKeeper"]


class RunKeeper:
    """Keeps each submap before it is given away; hands over, or draws anew, what others left.

    Parameters
    ----------
    folder
        Of this vehicle; empty: nothing is kept.
    vehicle_id
        Whose.
    config
        Of the mappers: with other settings no run is gone on with.
    complain
        Told when the disk does not take something, or gives it back damaged: mapping goes on.

    Raises
    ------
    SessionInUseError
        If another process has the folder.
    """

    def __init__(
        self,
        folder: str,
        vehicle_id: str,
        config: VehicleMapperConfig,
        complain: Callable[[str], None],
    ) -> None:
        self._folder, self._vehicle_id, self._complain = folder, vehicle_id, complain
        self._config = config.occupancy
        setup = repr((vehicle_id, config.to_dict())).encode()
        self._setup = hashlib.blake2b(setup, digest_size=16).digest()
        self._runs: KeptRuns | None = None
        self._unsaved: dict[SubmapId, Submap] = {}
        if folder:
            try:
                self._runs = KeptRuns(folder)
            except SessionInUseError:
                raise
            except DataError as error:
                complain(str(error))

    def keep(
        self, submaps: Sequence[Submap], pings: Mapping[SubmapId, Sequence[DrawnPing]]
    ) -> None:
        """Keep submaps that are about to be given away, with their pings.

        Those that the disk did not take are tried again with the next.
        """
        if not self._folder or not submaps:
            return
        self._unsaved.update((submap.submap_id, submap) for submap in submaps)
        try:
            if self._runs is None:
                self._runs = KeptRuns(self._folder)
            self._runs.save(list(self._unsaved.values()), pings)
            self._unsaved.clear()
        except DataError as error:
            self._complain(str(error))

    def keep_open(
        self, mapper: VehicleMapper, pings: Mapping[SubmapId, Sequence[DrawnPing]]
    ) -> None:
        """Keep what is in the open submap by now; those that are closed have to be kept."""
        if self._runs is None:
            return
        try:
            if self._unsaved:
                self._runs.forget_open()
            else:
                self._runs.save_open(mapper, pings, self._setup)
        except DataError as error:
            self._complain(str(error))

    def forget_open(self) -> None:
        """The run that goes on is over."""
        if self._runs is not None:
            try:
                self._runs.forget_open()
            except DataError as error:
                self._complain(str(error))

    def resume(self) -> ResumedRun | None:
        """The run of the process before, if this one can go on with it: `take` it then."""
        if self._runs is None:
            return None
        try:
            return self._runs.resume(self._vehicle_id, self._setup)
        except DataError as error:
            self._complain(f"{error}; it is not gone on with")
            return None

    def take(self, run: ResumedRun) -> None:
        """A run that was resumed is one of this process."""
        if self._runs is not None:
            self._runs.take(run)

    def earlier_drawn_anew(self) -> Iterator[list[Submap]]:
        """Each run of an earlier process once more; what has been taken is kept no longer."""
        # SciPy's solvers are large, and most of a node's life goes by without them.
        from uw_dslam_ros2.core.chart.redraw import redrawn

        if self._runs is None:
            return
        for path in list(self._runs.earlier):
            try:
                submaps, pings = self._runs.load(path)
            except DataError as error:
                self._complain(f"{error}; what it held will not be drawn anew")
                continue
            yield redrawn(submaps, pings, self._config)
            self._runs.forget(path)

    def forget_own(self) -> None:
        """What this process has mapped was drawn anew."""
        self._unsaved.clear()
        if self._runs is not None:
            self._runs.forget_own()

    def close(self) -> None:
        """Let another process have the folder."""
        if self._runs is not None:
            self._runs.close()
