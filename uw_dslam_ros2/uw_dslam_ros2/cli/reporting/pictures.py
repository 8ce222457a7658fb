"""Pictures of maps and trajectories, for reports."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from PIL import Image

from uw_dslam_ros2.cli.reporting.map_drawing import (
    AGREE_COLOR,
    EXTRA_COLOR,
    FOOT,
    FREE_COLOR,
    GAP,
    HEAD,
    INK,
    MISSING_COLOR,
    SEEN_COLOR,
    TITLE,
    UNKNOWN_COLOR,
    VEHICLE_COLORS,
    blank_figure,
    common_spec,
    draw_seam,
    draw_way,
    extent_m,
    legend_below,
    near_walls,
    scale_bar,
    set_title,
    shade_handles,
    shortened,
    show_cells,
    show_map,
    show_picture,
    single_map,
    to_bytes,
)
from uw_dslam_ros2.cli.reporting.outcome import Outcome
from uw_dslam_ros2.cli.reporting.scoring import Scores, Truth
from uw_dslam_ros2.core.grid import OccupancyMap, bounds_of, strips_of
from uw_dslam_ros2.core.merging import ConstraintKind, SubmapState
from uw_dslam_ros2.core.metrics import interpolate_poses, resample
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.view.pairs import KEY, lay_on

__all__ = [
    "before_after",
    "error_plot",
    "overlay",
    "png_bytes",
    "truth_comparison",
    "vehicle_colors",
]

FloatArray = NDArray[np.float64]
DECIDED_COLOR = "#5b2a86"
_COMPARED = (UNKNOWN_COLOR, SEEN_COLOR, FREE_COLOR, MISSING_COLOR, AGREE_COLOR, EXTRA_COLOR)
_UNKNOWN, _SEEN, _FREE, _MISSING, _AGREE, _EXTRA = range(len(_COMPARED))


def vehicle_colors(vehicles: Sequence[str]) -> dict[str, str]:
    """One colour for each vehicle."""
    return {
        name: VEHICLE_COLORS[i % len(VEHICLE_COLORS)] for i, name in enumerate(sorted(vehicles))
    }


def png_bytes(figure: Figure, dpi: int = 110) -> bytes:
    """Encode a figure with all that sticks out of it; the same figure gives the same bytes."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    drawn = figure.get_tightbbox(canvas.get_renderer()).padded(0.05)
    drawing = io.BytesIO()
    box = Bbox.union([Bbox.from_bounds(0.0, 0.0, *figure.get_size_inches()), drawn])
    canvas.print_figure(
        drawing, dpi=dpi, format="png", bbox_inches=box, pil_kwargs={"compress_level": 0}
    )
    picture = Image.open(drawing).convert("RGB")
    # Pictures of maps have few colours: with a palette they are a third of the size.
    buffer = io.BytesIO()
    picture.quantize(192, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
    return buffer.getvalue()


def before_after(outcome: Outcome, title: str, members: str = "vehicles") -> Figure:
    """Each vehicle's map by itself, and the one map of all, with ways and seams."""
    colors = vehicle_colors([v.vehicle_id for v in outcome.vehicles])
    names = shortened([v.vehicle_id for v in outcome.vehicles])
    own = [extent_m(vehicle.own_map) for vehicle in outcome.vehicles]
    merged = (1.0, 1.0) if outcome.global_map is None else extent_m(outcome.global_map)
    layout = _Layout.of(own, merged)
    figure = blank_figure(layout.width, layout.height)
    for vehicle, box in zip(outcome.vehicles, layout.small, strict=True):
        axes = figure.add_axes(layout.share(box))
        show_map(axes, vehicle.own_map)
        draw_way(axes, vehicle.own_trajectory, colors[vehicle.vehicle_id])
        scale_bar(axes)
        # One title: a second one would lie on it where the picture is small.
        state = " alone" if vehicle.is_merged else ": not merged"
        set_title(axes, f"{names[vehicle.vehicle_id]}{state}")
    _show_merged(figure.add_axes(layout.share(layout.large)), outcome, colors, names, members)
    figure.text(
        GAP / layout.width,
        1.0 - 0.22 / layout.height,
        title,
        ha="left",
        va="top",
        fontsize=16,
        color=INK,
        weight="bold",
    )
    return figure


_Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class _Layout:
    """Places of the pictures in inches from the lower left; all small ones have one scale."""

    width: float
    height: float
    small: tuple[_Box, ...]
    large: _Box

    def share(self, box: _Box) -> _Box:
        """As matplotlib takes it."""
        return (
            box[0] / self.width,
            box[1] / self.height,
            box[2] / self.width,
            box[3] / self.height,
        )

    @classmethod
    def of(cls, own: Sequence[tuple[float, float]], merged: tuple[float, float]) -> _Layout:
        """Put small pictures of maps (width, height) in metres beside or above the large one."""
        return (cls._beside if merged[0] < 1.5 * merged[1] else cls._above)(own, merged)

    @classmethod
    def _beside(cls, own: Sequence[tuple[float, float]], merged: tuple[float, float]) -> _Layout:
        height = 8.2  # of the large picture
        titles = TITLE * (len(own) - 1)
        scale = (height - titles) / sum(h for _, h in own)
        column = max(w for w, _ in own) * scale
        if column > 4.6:
            scale *= 4.6 / column
            column = 4.6
        top = FOOT + height
        boxes: list[_Box] = []
        free = height - titles - scale * sum(h for _, h in own)
        for w, h in own:
            bottom = top - h * scale
            boxes.append((GAP, bottom, w * scale, h * scale))
            top = bottom - TITLE - free / max(1, len(own) - 1)
        width = height * merged[0] / merged[1]
        left = 2.5 * GAP + max(column, 1.9)
        large = (left, FOOT, width, height)
        return cls(max(left + width + GAP, left + 6.7), height + FOOT + HEAD, tuple(boxes), large)

    @classmethod
    def _above(cls, own: Sequence[tuple[float, float]], merged: tuple[float, float]) -> _Layout:
        width = 12.5  # of the large picture
        height = width * merged[1] / merged[0]
        gaps = 2.0 * GAP * (len(own) - 1)
        scale = min((width - gaps) / sum(w for w, _ in own), 4.2 / max(h for _, h in own))
        row = scale * max(h for _, h in own)
        left, boxes = GAP, []
        gap = (width - scale * sum(w for w, _ in own)) / max(1, len(own) - 1)
        bottom = FOOT + height + TITLE + GAP
        for w, h in own:
            boxes.append((left, bottom + row - h * scale, w * scale, h * scale))
            left += w * scale + min(gap, 4.0 * GAP)
        large = (GAP, FOOT, width, height)
        return cls(width + 2.0 * GAP, bottom + row + HEAD, tuple(boxes), large)


def _show_merged(
    axes: Axes,
    outcome: Outcome,
    colors: Mapping[str, str],
    names: Mapping[str, str],
    members: str,
) -> None:
    merged = [v for v in outcome.vehicles if v.is_merged]
    left = [names[v.vehicle_id] for v in outcome.vehicles if not v.is_merged]
    set_title(
        axes,
        f"one map: {len(merged)} of {len(outcome.vehicles)} {members}",
        # The small pictures name them, too.
        f"not merged: {', '.join(left) if len(left) < 3 else len(left)}" if left else "",
    )
    if outcome.global_map is None:
        axes.text(0.5, 0.5, "nothing was merged", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    show_map(axes, outcome.global_map)
    shown = [record for record in outcome.records if record.state is SubmapState.MERGED]
    # Many seams must not hide the map.
    opacity = min(0.6, max(0.2, 12.0 / max(1, len(shown))))
    for record in shown:
        color = colors[record.submap.vehicle_id]
        draw_seam(axes, record.submap.grid, record.T_component_submap, color, opacity)
    handles: list[Any] = _draw_confirmed(axes, outcome)
    for vehicle in merged:
        color = colors[vehicle.vehicle_id]
        if vehicle.trajectory is not None:
            draw_way(axes, vehicle.trajectory, color)
        handles.append(Line2D([], [], color=color, lw=2, label=names[vehicle.vehicle_id]))
    handles += [
        Line2D(
            [],
            [],
            color="#555555",
            lw=1.2,
            ls=(0, (1, 1.5)),
            label="seam of a submap" if members == "vehicles" else "rim of a map",
        ),
        *shade_handles(),
    ]
    scale_bar(axes)
    legend_below(axes, handles)


def _draw_confirmed(axes: Axes, outcome: Outcome) -> list[Any]:
    """Draw what a person confirmed; handles for the legend."""
    places = {
        r.submap.submap_id: r.T_component_submap
        for r in outcome.records
        if r.state is SubmapState.MERGED
    }
    style: dict[str, Any] = {"color": DECIDED_COLOR, "lw": 2.0, "ls": (0, (5, 1.5, 1, 1.5))}
    count = 0
    for constraint in outcome.constraints:
        ends = constraint.source, constraint.target
        if constraint.kind is ConstraintKind.CONFIRMED and all(end in places for end in ends):
            x = [places[end].x for end in ends]
            y = [places[end].y for end in ends]
            axes.plot(x, y, **style)
            axes.plot(np.mean(x), np.mean(y), marker="D", color=DECIDED_COLOR, ms=6)
            count += 1
    if not count:
        return []
    return [Line2D([], [], **style, marker="D", label="confirmed by a person")]


def truth_comparison(outcome: Outcome, truth: Truth, scores: Scores) -> Figure | None:
    """Walls of the merged map over the true ones: what agrees, is missing, is too much."""
    if truth.map is None or outcome.global_map is None or scores.trajectory is None:
        return None
    spec = common_spec(truth.map, outcome.global_map, scores.trajectory.T_truth_map)
    found = resample(outcome.global_map, spec, scores.trajectory.T_truth_map)
    true = resample(truth.map, spec)
    tolerance_cells = 0.25 / spec.resolution_m
    shown = np.full(spec.shape, _UNKNOWN, np.uint8)
    reach = math.ceil(tolerance_cells) + 1
    for own, around, inside in strips_of(spec.num_rows, reach):
        near_true = near_walls(true[around] > 50, tolerance_cells)[inside]
        near_found = near_walls(found[around] > 50, tolerance_cells)[inside]
        strip, walls, true_walls = shown[own], found[own] > 50, true[own] > 50
        strip[(found[own] >= 0) | (true[own] >= 0)] = _SEEN
        strip[found[own] >= 0] = _FREE
        strip[true_walls & ~near_found] = _MISSING
        strip[walls & near_true] = _AGREE
        strip[walls & ~near_true] = _EXTRA
    figure, axes = single_map(spec)
    show_cells(axes, shown, _COMPARED, spec)
    scale_bar(axes)
    legend_below(
        axes,
        [
            Patch(color=AGREE_COLOR, label="wall, and there is one within 0.25 m"),
            Patch(color=EXTRA_COLOR, label="wall, and there is none"),
            Patch(color=MISSING_COLOR, label="true wall that was missed"),
            Patch(facecolor=FREE_COLOR, edgecolor="#999999", label="known"),
            Patch(facecolor=SEEN_COLOR, edgecolor="#999999", label="seen, but not in the map"),
        ],
    )
    set_title(axes, "the merged map against the true one")
    return figure


def error_plot(outcome: Outcome, truth: Truth, scores: Scores) -> Figure | None:
    """Distance from the true position over time, one line for each vehicle, one common frame."""
    if scores.trajectory is None:
        return None
    colors = vehicle_colors([v.vehicle_id for v in outcome.vehicles])
    figure = blank_figure(10.0, 3.2)
    axes = figure.add_axes((0.07, 0.17, 0.91, 0.72))
    start_ns = min(int(stamps[0]) for stamps, _ in outcome.trajectories().values())
    for name, (stamps_ns, poses) in outcome.trajectories().items():
        if name not in truth.trajectories:
            continue
        expected, is_inside = interpolate_poses(truth.trajectories[name], stamps_ns)
        moved = scores.trajectory.T_truth_map.apply(poses[is_inside, :2])
        error = np.hypot(*(moved - expected[is_inside, :2]).T)
        time_s = (stamps_ns[is_inside] - start_ns) * 1e-9
        axes.plot(time_s, error, color=colors[name], lw=1.6, label=name)
    axes.set(xlabel="time [s]", ylabel="error [m]", ylim=(0.0, None))
    axes.set_title("Distance from the true position", loc="left", fontsize=11, color=INK)
    axes.grid(color="#e3e7ea", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.99), fontsize=9)
    return figure


def overlay(
    source: OccupancyMap, target: OccupancyMap, T_target_source: SE2, title: str
) -> Figure:
    """Lay a source map on a target map, as the view does: where walls agree, and where not."""
    pair = lay_on(target, source, T_target_source)
    rgba, spec = pair.agreement(), pair.spec
    box = bounds_of((pair.target >= 0) | (pair.source >= 0))
    if box is not None:
        rgba = rgba[box]
        spec = spec.part(box[0].start, box[1].start, *rgba.shape[:2])
    picture = np.where(rgba[:, :, 3:] > 0, rgba[:, :, :3], to_bytes(UNKNOWN_COLOR))
    figure, axes = single_map(spec)
    show_picture(axes, picture.astype(np.uint8), spec)
    scale_bar(axes)
    set_title(axes, title)
    patches = [
        Patch(facecolor=np.array(colour[:3]) / 255.0, edgecolor="#999999", label=name)
        for name, colour in KEY.items()
    ]
    legend_below(axes, patches)
    return figure
