"""Pictures of maps and trajectories, for reports."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray
from PIL import Image

from uw_dslam_ros2.cli.outcome import Outcome, Trajectory
from uw_dslam_ros2.cli.scoring import Scores, Truth
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import SubmapState
from uw_dslam_ros2.core.metrics import interpolate_poses, resample
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "before_after",
    "error_plot",
    "overlay",
    "png_bytes",
    "truth_comparison",
    "vehicle_colors",
]

FloatArray = NDArray[np.float64]

# Okabe and Ito's colours, which people with any colour vision tell apart.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_WALL, _FREE, _UNKNOWN = (0.08, 0.08, 0.10), (1.0, 1.0, 1.0), (0.80, 0.82, 0.84)
_AGREE, _EXTRA, _MISSING = (0.10, 0.10, 0.12), (0.835, 0.369, 0.0), (0.0, 0.447, 0.698)
_SEEN = (0.93, 0.94, 0.95)
_INK = "#1c2733"
_MAX_PIXELS = 1600
_MARGIN_CELLS = 12


def vehicle_colors(vehicles: Sequence[str]) -> dict[str, str]:
    """One colour for each vehicle."""
    return {name: _COLORS[i % len(_COLORS)] for i, name in enumerate(sorted(vehicles))}


def png_bytes(figure: Figure, dpi: int = 110) -> bytes:
    """Encode a figure; the same figure gives the same bytes."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    # Pictures of maps have few colours: with a palette they are a third of the size.
    buffer = io.BytesIO()
    picture.quantize(192, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
    return buffer.getvalue()


def before_after(outcome: Outcome, title: str) -> Figure:
    """Each vehicle's map by itself, and the one map of all, with ways and seams."""
    colors = vehicle_colors([v.vehicle_id for v in outcome.vehicles])
    own = [_extent_m(vehicle.own_map) for vehicle in outcome.vehicles]
    merged = (1.0, 1.0) if outcome.global_map is None else _extent_m(outcome.global_map)
    layout = _Layout.of(own, merged)
    figure = _figure(layout.width, layout.height)
    for vehicle, box in zip(outcome.vehicles, layout.small, strict=True):
        axes = figure.add_axes(layout.share(box))
        _show_map(axes, vehicle.own_map)
        _draw_way(axes, vehicle.own_trajectory, colors[vehicle.vehicle_id])
        _scale_bar(axes)
        _title(axes, f"{vehicle.vehicle_id} alone", "" if vehicle.is_merged else "not merged")
    _show_merged(figure.add_axes(layout.share(layout.large)), outcome, colors)
    figure.text(
        _GAP / layout.width,
        1.0 - 0.22 / layout.height,
        title,
        ha="left",
        va="top",
        fontsize=16,
        color=_INK,
        weight="bold",
    )
    return figure


_Box = tuple[float, float, float, float]
_GAP, _HEAD, _TITLE, _FOOT = 0.25, 0.75, 0.32, 0.42  # inches


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
        titles = _TITLE * (len(own) - 1)
        scale = (height - titles) / sum(h for _, h in own)
        column = max(w for w, _ in own) * scale
        if column > 4.6:
            scale *= 4.6 / column
            column = 4.6
        top = _FOOT + height
        boxes: list[_Box] = []
        free = height - titles - scale * sum(h for _, h in own)
        for w, h in own:
            bottom = top - h * scale
            boxes.append((_GAP, bottom, w * scale, h * scale))
            top = bottom - _TITLE - free / max(1, len(own) - 1)
        width = height * merged[0] / merged[1]
        left = 2.5 * _GAP + max(column, 1.9)
        large = (left, _FOOT, width, height)
        return cls(
            max(left + width + _GAP, left + 6.2), height + _FOOT + _HEAD, tuple(boxes), large
        )

    @classmethod
    def _above(cls, own: Sequence[tuple[float, float]], merged: tuple[float, float]) -> _Layout:
        width = 12.5  # of the large picture
        height = width * merged[1] / merged[0]
        gaps = 2.0 * _GAP * (len(own) - 1)
        scale = min((width - gaps) / sum(w for w, _ in own), 4.2 / max(h for _, h in own))
        row = scale * max(h for _, h in own)
        left, boxes = _GAP, []
        gap = (width - scale * sum(w for w, _ in own)) / max(1, len(own) - 1)
        bottom = _FOOT + height + _TITLE + _GAP
        for w, h in own:
            boxes.append((left, bottom + row - h * scale, w * scale, h * scale))
            left += w * scale + min(gap, 4.0 * _GAP)
        large = (_GAP, _FOOT, width, height)
        return cls(width + 2.0 * _GAP, bottom + row + _HEAD, tuple(boxes), large)


def _show_merged(axes: Axes, outcome: Outcome, colors: Mapping[str, str]) -> None:
    merged = [v for v in outcome.vehicles if v.is_merged]
    left = [v.vehicle_id for v in outcome.vehicles if not v.is_merged]
    _title(
        axes,
        f"one map: {len(merged)} of {len(outcome.vehicles)} vehicles",
        f"not merged: {', '.join(left)}" if left else "",
    )
    if outcome.global_map is None:
        axes.text(0.5, 0.5, "nothing was merged", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    _show_map(axes, outcome.global_map)
    shown = [record for record in outcome.records if record.state is SubmapState.MERGED]
    # Many seams must not hide the map.
    opacity = min(0.6, max(0.2, 12.0 / max(1, len(shown))))
    for record in shown:
        color = colors[record.submap.vehicle_id]
        _draw_seam(axes, record.submap.grid, record.T_component_submap, color, opacity)
    handles: list[Any] = []
    for vehicle in merged:
        if vehicle.trajectory is not None:
            color = colors[vehicle.vehicle_id]
            _draw_way(axes, vehicle.trajectory, color)
            handles.append(Line2D([], [], color=color, lw=2, label=vehicle.vehicle_id))
    handles += [
        Line2D([], [], color="#555555", lw=1.2, ls=(0, (1, 1.5)), label="seam of a submap"),
        *_shade_handles(),
    ]
    _scale_bar(axes)
    _legend_below(axes, handles)


def truth_comparison(outcome: Outcome, truth: Truth, scores: Scores) -> Figure | None:
    """Walls of the merged map over the true ones: what agrees, is missing, is too much."""
    if truth.map is None or outcome.global_map is None or scores.trajectory is None:
        return None
    spec = _common_spec(truth.map, outcome.global_map, scores.trajectory.T_truth_map)
    found = resample(outcome.global_map, spec, scores.trajectory.T_truth_map)
    true = resample(truth.map, spec)
    tolerance_cells = 0.25 / spec.resolution_m
    near_true = _near(true > 50, tolerance_cells)
    near_found = _near(found > 50, tolerance_cells)
    picture = np.empty((*spec.shape, 3), dtype=np.uint8)
    picture[:] = _byte(_UNKNOWN)
    picture[(found >= 0) | (true >= 0)] = _byte(_SEEN)
    picture[found >= 0] = _byte(_FREE)
    picture[(true > 50) & ~near_found] = _byte(_MISSING)
    picture[(found > 50) & near_true] = _byte(_AGREE)
    picture[(found > 50) & ~near_true] = _byte(_EXTRA)
    figure, axes = _single(spec)
    _show_picture(axes, picture, spec)
    _scale_bar(axes)
    _legend_below(
        axes,
        [
            Patch(color=_AGREE, label="wall, and there is one within 0.25 m"),
            Patch(color=_EXTRA, label="wall, and there is none"),
            Patch(color=_MISSING, label="true wall that was missed"),
            Patch(facecolor=_FREE, edgecolor="#999999", label="known"),
            Patch(facecolor=_SEEN, edgecolor="#999999", label="seen, but not in the map"),
        ],
    )
    _title(axes, "the merged map against the true one")
    return figure


def error_plot(outcome: Outcome, truth: Truth, scores: Scores) -> Figure | None:
    """Distance from the true position over time, one line for each vehicle, one common frame."""
    if scores.trajectory is None:
        return None
    colors = vehicle_colors([v.vehicle_id for v in outcome.vehicles])
    figure = _figure(10.0, 3.2)
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
    axes.set_title("Distance from the true position", loc="left", fontsize=11, color=_INK)
    axes.grid(color="#e3e7ea", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.99), fontsize=9)
    return figure


def overlay(
    source: OccupancyMap, target: OccupancyMap, T_target_source: SE2, title: str
) -> Figure:
    """Lay a source map on a target map: their walls in two colours, and where both agree."""
    spec = _common_spec(target, source, T_target_source)
    found, true = resample(source, spec, T_target_source), resample(target, spec)
    picture = np.empty((*spec.shape, 3), dtype=np.uint8)
    picture[:] = _byte(_UNKNOWN)
    picture[(found >= 0) ^ (true >= 0)] = _byte(_SEEN)
    picture[(found >= 0) & (true >= 0)] = _byte(_FREE)
    tolerance_cells = 2.0
    both = (true > 50) & _near(found > 50, tolerance_cells)
    both |= (found > 50) & _near(true > 50, tolerance_cells)
    picture[true > 50] = _byte(_MISSING)
    picture[found > 50] = _byte(_EXTRA)
    picture[both] = _byte(_AGREE)
    figure, axes = _single(spec)
    _show_picture(axes, picture, spec)
    _scale_bar(axes)
    _title(axes, title)
    _legend_below(
        axes,
        [
            Patch(color=_EXTRA, label="walls of the source"),
            Patch(color=_MISSING, label="walls of the target"),
            Patch(color=_AGREE, label="walls of both"),
            Patch(facecolor=_FREE, edgecolor="#999999", label="seen by both"),
        ],
    )
    return figure


# --- parts -----------------------------------------------------------------------------------


def _figure(width: float, height: float) -> Figure:
    with mpl.rc_context({"font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _single(spec: GridSpec) -> tuple[Figure, Axes]:
    """Axes for one map, in a figure of its shape."""
    corners = spec.corners()
    wide, high = corners.max(axis=0) - corners.min(axis=0)
    scale = min(10.5 / wide, 8.0 / high)
    width, height = wide * scale, high * scale
    total = (max(width, 6.4) + 2.0 * _GAP, height + _FOOT + 2.0 * _TITLE)
    figure = _figure(*total)
    box = (_GAP / total[0], _FOOT / total[1], width / total[0], height / total[1])
    return figure, figure.add_axes(box)


def _title(axes: Axes, text: str, warning: str = "") -> None:
    axes.set_title(text, fontsize=10.5, loc="left", color=_INK, pad=4)
    if warning:
        axes.set_title(warning, fontsize=10.5, loc="right", color=_COLORS[1], pad=4, weight="bold")


def _cropped(occupancy: OccupancyMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last (exclusive) cell of what is known, with a margin."""
    seen = np.argwhere(occupancy.known)
    if len(seen) == 0:
        return np.zeros(2, np.int64), np.array(occupancy.spec.shape)
    low = np.maximum(seen.min(axis=0) - _MARGIN_CELLS, 0)
    high = np.minimum(seen.max(axis=0) + 1 + _MARGIN_CELLS, occupancy.spec.shape)
    return low, high


def _extent_m(occupancy: OccupancyMap) -> tuple[float, float]:
    """Width and height of what `_show_map` shows."""
    low, high = _cropped(occupancy)
    resolution = occupancy.spec.resolution_m
    box = np.array([[low[1], low[0]], [high[1], low[0]], [high[1], high[0]], [low[1], high[0]]])
    corners = occupancy.spec.T_frame_grid.apply(box * resolution)
    size = corners.max(axis=0) - corners.min(axis=0)
    return float(size[0]), float(size[1])


def _show_map(axes: Axes, occupancy: OccupancyMap) -> None:
    values = occupancy.values
    # Between free and wall the shade follows the probability.
    share = np.linspace(0.0, 1.0, OCCUPIED - FREE + 1)[:, None]
    shades = (1.0 - share) * np.array(_FREE) + share * np.array(_WALL)
    table = np.rint(255.0 * np.vstack([_UNKNOWN, shades])).astype(np.uint8)
    low, high = _cropped(occupancy)
    picture = table[values[low[0] : high[0], low[1] : high[1]] - UNKNOWN]
    _show_picture(axes, picture, occupancy.spec, low, high)


def _show_picture(
    axes: Axes,
    picture: NDArray[np.uint8],
    spec: GridSpec,
    low: NDArray[np.int64] | None = None,
    high: NDArray[np.int64] | None = None,
) -> None:
    """Show a picture of the cells from `low` to `high` as they lie; thin walls stay visible."""
    low = np.zeros(2, np.int64) if low is None else low
    high = np.array(spec.shape) if high is None else high
    factor = max(1, math.ceil(max(picture.shape[:2]) / _MAX_PIXELS))
    picture = _darkest(picture, factor)
    resolution = spec.resolution_m
    first = low * resolution
    last = first + np.array(picture.shape[:2]) * factor * resolution
    origin = spec.T_frame_grid
    motion = Affine2D().rotate(origin.yaw).translate(origin.x, origin.y)
    image = axes.imshow(
        picture,
        extent=(first[1], last[1], first[0], last[0]),
        origin="lower",
        interpolation="nearest",
        aspect="auto",
    )
    image.set_transform(motion + axes.transData)
    end = high * resolution
    box = [[first[1], first[0]], [end[1], first[0]], [end[1], end[0]], [first[1], end[0]]]
    corners = motion.transform(box)
    axes.set_xlim(corners[:, 0].min(), corners[:, 0].max())
    axes.set_ylim(corners[:, 1].min(), corners[:, 1].max())
    axes.set_aspect("equal", anchor="SW")
    axes.set_facecolor(_UNKNOWN)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#c4cad0")


def _byte(color: tuple[float, float, float]) -> NDArray[np.uint8]:
    return np.rint(255.0 * np.array(color)).astype(np.uint8)


def _darkest(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce by a whole factor; of each block the darkest cell stays."""
    if factor == 1:
        return picture
    rows, cols = (math.ceil(n / factor) * factor for n in picture.shape[:2])
    padded = np.empty((rows, cols, 3), dtype=np.uint8)
    padded[:] = _byte(_UNKNOWN)
    padded[: picture.shape[0], : picture.shape[1]] = picture
    blocks = padded.reshape(rows // factor, factor, cols // factor, factor, 3).swapaxes(1, 2)
    blocks = blocks.reshape(rows // factor, cols // factor, factor * factor, 3)
    index = blocks.sum(axis=-1, dtype=np.uint16).argmin(axis=-1)
    return np.take_along_axis(blocks, index[..., None, None], axis=2)[:, :, 0]


def _draw_way(axes: Axes, trajectory: Trajectory, color: str) -> None:
    poses = trajectory[1]
    if len(poses) == 0:
        return
    axes.plot(poses[:, 0], poses[:, 1], color="white", lw=3.0, alpha=0.8, solid_capstyle="round")
    axes.plot(poses[:, 0], poses[:, 1], color=color, lw=1.6, solid_capstyle="round")
    for place, mark in ((poses[0], "o"), (poses[-1], "s")):
        axes.plot(*place[:2], mark, color=color, mec="white", mew=1.0, ms=7, clip_on=False)


def _draw_seam(
    axes: Axes, grid: OccupancyMap, T_map_submap: SE2, color: str, opacity: float
) -> None:
    factor = max(1, max(grid.spec.shape) // 300)
    # Shadows within, and single beams at the rim of what a submap has seen, are no seams.
    known = grid.known[::factor, ::factor].astype(np.uint8)
    known = cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
    known = cv2.morphologyEx(known, cv2.MORPH_OPEN, np.ones((11, 11), np.uint8))
    contours, _ = cv2.findContours(known, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        if cv2.contourArea(contour) < 0.02 * known.sum():
            continue
        cells = contour[:, 0, ::-1] * factor
        points = T_map_submap.apply(grid.spec.centers_of(np.vstack([cells, cells[:1]])))
        axes.plot(points[:, 0], points[:, 1], color=color, lw=0.9, ls=(0, (1, 1.8)), alpha=opacity)


def _scale_bar(axes: Axes) -> None:
    """Draw a bar of a round length in the lower left corner."""
    (x_low, x_high), (y_low, y_high) = axes.get_xlim(), axes.get_ylim()
    width = x_high - x_low
    target = min(0.3 * width, 0.5 * (y_high - y_low))
    power = 10.0 ** math.floor(math.log10(target))
    length = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= target)
    inches = axes.get_window_extent().width / axes.figure.dpi
    bar = AnchoredSizeBar(
        axes.transData,
        length,
        f"{length:g} m",
        "lower left",
        pad=0.35,
        borderpad=0.5,
        sep=3,
        color=_INK,
        size_vertical=0.04 * width / inches,
        fontproperties=FontProperties(size=8),
    )
    bar.patch.set(alpha=0.85, linewidth=0)
    bar.set_zorder(6)
    axes.add_artist(bar)


def _shade_handles() -> list[Patch]:
    return [
        Patch(facecolor=_WALL, label="wall"),
        Patch(facecolor=_FREE, edgecolor="#999999", label="free"),
        Patch(facecolor=_UNKNOWN, label="unknown"),
    ]


def _legend_below(axes: Axes, handles: list[Any]) -> None:
    axes.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.01),
        ncols=min(len(handles), 8),
        frameon=False,
        fontsize=9,
        handlelength=1.4,
        columnspacing=1.4,
        borderaxespad=0.2,
    )


def _near(walls: NDArray[np.bool_], distance_cells: float) -> NDArray[np.bool_]:
    reach = max(1, round(distance_cells))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(walls.astype(np.uint8), kernel) > 0


def _common_spec(target: OccupancyMap, source: OccupancyMap, T_target_source: SE2) -> GridSpec:
    """Take the target's cells, over all that either map knows."""
    known = np.argwhere(source.known)
    cells = target.spec.cells_of(T_target_source.apply(source.spec.centers_of(known)))
    own = np.argwhere(target.known)
    every = np.concatenate([cells, own]) if len(own) else cells
    low, high = every.min(axis=0) - _MARGIN_CELLS, every.max(axis=0) + 1 + _MARGIN_CELLS
    resolution = target.spec.resolution_m
    corner = target.spec.T_frame_grid @ SE2(low[1] * resolution, low[0] * resolution)
    return GridSpec(resolution, int(high[0] - low[0]), int(high[1] - low[1]), corner)
