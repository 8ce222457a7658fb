"""Walls of a run's map as lines, and a picture of them."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from uw_dslam_ros2.cli.reporting.map_drawing import (
    legend_below,
    scale_bar,
    set_title,
    show_map,
    single_map,
)
from uw_dslam_ros2.cli.reporting.outcome import Outcome
from uw_dslam_ros2.core.chart.lines import Pier, Wall, trace_walls
from uw_dslam_ros2.core.grid import UNKNOWN, OccupancyMap
from uw_dslam_ros2.core.merging import SubmapState, last_seen_ns

__all__ = ["walls_of", "walls_picture"]

_LINE_COLOR, _PIER_COLOR = "#D55E00", "#0072B2"


def walls_of(outcome: Outcome) -> tuple[list[Wall], list[Pier]]:
    """Walls and piers of the global map; none where there is no map."""
    if outcome.global_map is None:
        return [], []
    merged = [record for record in outcome.records if record.state is SubmapState.MERGED]
    ages = functools.partial(last_seen_ns, outcome.global_map.spec, merged)
    return trace_walls(outcome.global_map, ages)


def walls_picture(occupancy: OccupancyMap, walls: Sequence[Wall], piers: Sequence[Pier]) -> Figure:
    """The lines over what of the map is water."""
    figure, axes = single_map(occupancy.spec)
    water = np.where(occupancy.values > 50, UNKNOWN, occupancy.values)
    show_map(axes, OccupancyMap(occupancy.spec, water))
    axes.add_collection(
        LineCollection([wall.points for wall in walls], colors=_LINE_COLOR, linewidths=1.2)
    )
    if piers:
        places = np.array([(pier.x, pier.y) for pier in piers])
        axes.scatter(places[:, 0], places[:, 1], s=14, marker="s", color=_PIER_COLOR, zorder=3)
    scale_bar(axes)
    length_m = sum(wall.length_m for wall in walls)
    set_title(axes, f"{len(walls)} walls, {length_m:.0f} m, and {len(piers)} piers")
    legend_below(
        axes,
        [
            Line2D([], [], color=_LINE_COLOR, label="wall"),
            Line2D([], [], color=_PIER_COLOR, marker="s", linestyle="", label="pier"),
        ],
    )
    return figure
