"""Keeps on disk what a mapper has mapped, so that its last pass outlives the process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.mapping import OccupancyConfig
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.sessions.folder_lock import SessionInUseError
from uw_dslam_ros2.io.sessions.kept_runs import KeptRuns

__all__ = ["RunKeeper"]


class RunKeeper:
    """Keeps each submap before it is given away, and draws anew what earlier processes left.

    Parameters
    ----------
    folder
        Of this vehicle; empty: nothing is kept.
    config
        Grid and sensor model of the mappers.
    complain
        Told when the disk does not take something, or gives it back damaged: mapping goes on.

    Raises
    ------
    SessionInUseError
        If another process has the folder.
    """

    def __init__(
        self, folder: str, config: OccupancyConfig, complain: Callable[[str], None]
    ) -> None:
        self._folder, self._config, self._complain = folder, config, complain
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
