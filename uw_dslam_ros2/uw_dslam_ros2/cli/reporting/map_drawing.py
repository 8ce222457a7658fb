"""Parts of the pictures: maps, ways, seams, scale bars and legends on axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from uw_dslam_ros2.cli.reporting.outcome import Trajectory
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap, bounds_of
from uw_dslam_ros2.core.metrics import ends_of_rows
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "AGREE_COLOR",
    "EXTRA_COLOR",
    "FOOT",
    "FREE_COLOR",
    "GAP",
    "HEAD",
    "INK",
    "MISSING_COLOR",
    "SEEN_COLOR",
    "TITLE",
    "UNKNOWN_COLOR",
    "VEHICLE_COLORS",
    "blank_figure",
    "common_spec",
    "draw_seam",
    "draw_way",
    "extent_m",
    "legend_below",
    "near_walls",
    "scale_bar",
    "set_title",
    "shade_handles",
    "show_cells",
    "show_map",
    "show_picture",
    "single_map",
    "to_bytes",
]

FloatArray = NDArray[np.float64]
Color = tuple[float, float, float]

# Okabe and Ito's colours, which people with any colour vision tell apart.
VEHICLE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
WALL_COLOR, FREE_COLOR, UNKNOWN_COLOR = (0.08, 0.08, 0.10), (1.0, 1.0, 1.0), (0.80, 0.82, 0.84)
AGREE_COLOR, EXTRA_COLOR, MISSING_COLOR = (
    (0.10, 0.10, 0.12),
    (0.835, 0.369, 0.0),
    (0.0, 0.447, 0.698),
)
SEEN_COLOR = (0.93, 0.94, 0.95)
INK = "#1c2733"
_MAX_PIXELS = 1600
_STRIP_ROWS = 256
_MARGIN_CELLS = 12
_MAX_NAME = 15  # characters of a title of the narrowest picture
GAP, HEAD, TITLE, FOOT = 0.25, 0.75, 0.32, 0.42  # inches


def blank_figure(width: float, height: float) -> Figure:
    """An empty figure; sizes in inches."""
    with mpl.rc_context({"font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def single_map(spec: GridSpec) -> tuple[Figure, Axes]:
    """Axes for one map, in a figure of its shape."""
    corners = spec.corners()
    wide, high = corners.max(axis=0) - corners.min(axis=0)
    scale = min(10.5 / wide, 8.0 / high)
    width, height = wide * scale, high * scale
    total = (max(width, 6.4) + 2.0 * GAP, height + FOOT + 2.0 * TITLE)
    figure = blank_figure(*total)
    box = (GAP / total[0], FOOT / total[1], width / total[0], height / total[1])
    return figure, figure.add_axes(box)


def set_title(axes: Axes, text: str, warning: str = "") -> None:
    """Write a title on the left, and a warning on the right."""
    axes.set_title(text, fontsize=10.5, loc="left", color=INK, pad=4)
    if warning:
        axes.set_title(
            warning, fontsize=10.5, loc="right", color=VEHICLE_COLORS[1], pad=4, weight="bold"
        )


def cropped(occupancy: OccupancyMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last (exclusive) cell of what is known, with a margin."""
    box = bounds_of(occupancy.known)
    if box is None:
        return np.zeros(2, np.int64), np.array(occupancy.spec.shape)
    low = np.maximum([along.start - _MARGIN_CELLS for along in box], 0)
    high = np.minimum([along.stop + _MARGIN_CELLS for along in box], occupancy.spec.shape)
    return low, high


def extent_m(occupancy: OccupancyMap) -> tuple[float, float]:
    """Width and height of what `_show_map` shows."""
    low, high = cropped(occupancy)
    resolution = occupancy.spec.resolution_m
    box = np.array([[low[1], low[0]], [high[1], low[0]], [high[1], high[0]], [low[1], high[0]]])
    corners = occupancy.spec.T_frame_grid.apply(box * resolution)
    size = corners.max(axis=0) - corners.min(axis=0)
    return float(size[0]), float(size[1])


def show_map(axes: Axes, occupancy: OccupancyMap) -> None:
    """Show what a map knows."""
    values = occupancy.values
    # From free to wall by the probability: what is as likely as not looks like what is unknown.
    sure = np.linspace(-1.0, 1.0, OCCUPIED - FREE + 1)[:, None]
    ends = np.where(sure < 0.0, FREE_COLOR, WALL_COLOR)
    shades = (1.0 - np.abs(sure)) * np.array(UNKNOWN_COLOR) + np.abs(sure) * ends
    table = np.rint(255.0 * np.vstack([UNKNOWN_COLOR, shades])).astype(np.uint8)
    low, high = cropped(occupancy)
    cells = values[low[0] : high[0], low[1] : high[1]]
    _show(axes, cells, lambda strip: table[strip - UNKNOWN], occupancy.spec, low, high)


def show_cells(
    axes: Axes, cells: NDArray[np.uint8], colors: Sequence[Color], spec: GridSpec
) -> None:
    """Show cells (R, C), each the number of its colour, as they lie; thin walls stay visible."""
    table = np.array([to_bytes(color) for color in colors])
    _show(axes, cells, lambda strip: table[strip], spec, *_ends_of(spec))


def show_picture(axes: Axes, picture: NDArray[np.uint8], spec: GridSpec) -> None:
    """Show a picture (R, C, 3) of all cells as they lie; thin walls stay visible."""
    _show(axes, picture, lambda strip: strip, spec, *_ends_of(spec))


def _ends_of(spec: GridSpec) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return np.zeros(2, np.int64), np.array(spec.shape)


def _show(
    axes: Axes,
    cells: NDArray[Any],
    colors_of: Callable[[NDArray[Any]], NDArray[np.uint8]],
    spec: GridSpec,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
) -> None:
    """Show the cells from `low` to `high`; ``colors_of`` makes a picture of some rows of them."""
    factor = max(1, math.ceil(max(cells.shape[:2]) / _MAX_PIXELS))
    # By strips: in colours, and with room at the edges, a large map would be there many times.
    step = factor * max(1, _STRIP_ROWS // factor)
    strips = [cells[row : row + step] for row in range(0, len(cells), step)]
    picture = np.concatenate([darkest(colors_of(strip), factor) for strip in strips])
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
    axes.set_facecolor(UNKNOWN_COLOR)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#c4cad0")


def to_bytes(color: Color) -> NDArray[np.uint8]:
    """A colour (3,) as a picture holds it."""
    return np.rint(255.0 * np.array(color)).astype(np.uint8)


def darkest(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce by a whole factor; of each block the darkest cell stays."""
    if factor == 1:
        return picture
    rows, cols = (math.ceil(n / factor) * factor for n in picture.shape[:2])
    padded = np.empty((rows, cols, 3), dtype=np.uint8)
    padded[:] = to_bytes(UNKNOWN_COLOR)
    padded[: picture.shape[0], : picture.shape[1]] = picture
    blocks = padded.reshape(rows // factor, factor, cols // factor, factor, 3).swapaxes(1, 2)
    blocks = blocks.reshape(rows // factor, cols // factor, factor * factor, 3)
    index = blocks.sum(axis=-1, dtype=np.uint16).argmin(axis=-1)
    return np.take_along_axis(blocks, index[..., None, None], axis=2)[:, :, 0]


def draw_way(axes: Axes, trajectory: Trajectory, color: str) -> None:
    """Draw a trajectory: a circle at its start, a square at its end."""
    poses = trajectory[1]
    if len(poses) == 0:
        return
    axes.plot(poses[:, 0], poses[:, 1], color="white", lw=3.0, alpha=0.8, solid_capstyle="round")
    axes.plot(poses[:, 0], poses[:, 1], color=color, lw=1.6, solid_capstyle="round")
    for place, mark in ((poses[0], "o"), (poses[-1], "s")):
        axes.plot(*place[:2], mark, color=color, mec="white", mew=1.0, ms=7, clip_on=False)


def draw_seam(
    axes: Axes, grid: OccupancyMap, T_map_submap: SE2, color: str, opacity: float
) -> None:
    """Draw the outline of what a submap has seen."""
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


def scale_bar(axes: Axes) -> None:
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
        color=INK,
        size_vertical=0.04 * width / inches,
        fontproperties=FontProperties(size=8),
    )
    bar.patch.set(alpha=0.85, linewidth=0)
    bar.set_zorder(6)
    axes.add_artist(bar)


def shade_handles() -> list[Patch]:
    """Legend of the shades of a map."""
    return [
        Patch(facecolor=WALL_COLOR, label="wall"),
        Patch(facecolor=FREE_COLOR, edgecolor="#999999", label="free"),
        Patch(facecolor=UNKNOWN_COLOR, label="unknown"),
    ]


def legend_below(axes: Axes, handles: list[Any]) -> None:
    """Put a legend below the picture, in as many columns as the figure has room for."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # the axes are drawn
    for columns in range(min(len(handles), 8), 0, -1):
        legend = axes.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.0, -0.01),
            ncols=columns,
            frameon=False,
            fontsize=9,
            handlelength=1.4,
            columnspacing=1.4,
            borderaxespad=0.2,
        )
        if legend.get_window_extent().x1 <= figure.bbox.x1:
            return


def shortened(names: Sequence[str]) -> dict[str, str]:
    """Names that fit into a picture, and differ: of long ones, the middle is left out."""
    short = {name: _without_middle(name) for name in names}
    if len(set(short.values())) < len(set(names)):
        letters = enumerate(zip(*names, strict=False))
        start = next((i for i, found in letters if len({*found}) > 1), min(map(len, names)))
        short = {name: _without_middle(f"\u2026{name[start:]}") for name in names}
    return short if len(set(short.values())) == len(set(names)) else {n: n for n in names}


def _without_middle(name: str) -> str:
    if len(name) <= _MAX_NAME:
        return name
    half = (_MAX_NAME - 1) // 2
    return f"{name[:half]}\u2026{name[-half:]}"


def near_walls(walls: NDArray[np.bool_], distance_cells: float) -> NDArray[np.bool_]:
    """Cells not farther than a distance from a wall."""
    reach = max(1, round(distance_cells))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(walls.astype(np.uint8), kernel) > 0


def common_spec(target: OccupancyMap, source: OccupancyMap, T_target_source: SE2) -> GridSpec:
    """Take the target's cells, over all that either map knows."""
    known = ends_of_rows(source.known)
    cells = target.spec.cells_of(T_target_source.apply(source.spec.centers_of(known)))
    own = ends_of_rows(target.known)
    every = np.concatenate([cells, own]) if len(own) else cells
    low, high = every.min(axis=0) - _MARGIN_CELLS, every.max(axis=0) + 1 + _MARGIN_CELLS
    return target.spec.part(*low.tolist(), *(high - low).tolist())
