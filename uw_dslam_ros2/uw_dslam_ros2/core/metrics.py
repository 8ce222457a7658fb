"""How good a trajectory or a map is.

The global frame of a merged map differs from the world's by one rigid motion, the same for all
vehicles. `trajectory_error` finds it from the trajectories; maps are compared under that motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.metrics import structural_similarity
from skimage.morphology import skeletonize

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap, strips_of
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = [
    "MapError",
    "MapSharpness",
    "TrajectoryError",
    "align_points",
    "compare_maps",
    "ends_of_rows",
    "interpolate_poses",
    "map_sharpness",
    "resample",
    "trajectory_error",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Trajectory = tuple[IntArray, FloatArray]
"""Stamps (K,) [ns], rising, and poses (K, 3) [x, y, yaw] in metres and radians."""

_SSIM_WINDOW = 7


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """Absolute trajectory error of all vehicles in one frame, after one rigid alignment of all.

    ``rmse_m`` is the root of the mean squared distance over all poses of all vehicles, and
    ``per_vehicle_rmse_m`` the same over each vehicle's poses under the *common* alignment.
    ``rmse_rad`` is that of the yaw differences under the same alignment.
    """

    T_truth_map: SE2
    rmse_m: float
    median_m: float
    max_m: float
    rmse_rad: float
    num_poses: int
    per_vehicle_rmse_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class MapError:
    """A map against a true one, on the true one's lattice; see `compare_maps`."""

    mse: float
    ssim: float
    wall_iou: float
    wall_iou_tolerant: float
    wall_precision: float
    wall_recall: float
    coverage: float


@dataclass(frozen=True, slots=True)
class MapSharpness:
    """How crisp a map is, without any truth; see `map_sharpness`."""

    entropy_bits: float
    wall_entropy_bits: float
    wall_share: float
    wall_thickness_cells: float


def align_points(source: ArrayLike, target: ArrayLike) -> SE2:
    """Rigid motion that brings points (N, 2) closest to their partners (N, 2), in least squares.

    No scale (Kabsch; Umeyama 1991 with c = 1). With one point, or all in one place, the rotation
    is 0.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 2 or not len(source):
        raise InvalidInputError(
            f"source has shape {source.shape} and target {target.shape}, expected (N > 0, 2) twice"
        )
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    # In the plane the optimal angle has a closed form.
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    cosine = float(np.sum(a * b))
    yaw = math.atan2(sine, cosine)
    shift = target_mean - SE2(0.0, 0.0, yaw).apply(source_mean)
    return SE2(float(shift[0]), float(shift[1]), yaw)


def interpolate_poses(trajectory: Trajectory, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Poses (M, 3) at other times, linear in x, y and along the short way in yaw.

    Also a mask (M,), False outside the trajectory's span, where the poses are NaN.
    """
    own, poses = np.asarray(trajectory[0]), np.asarray(trajectory[1], dtype=np.float64)
    if len(own) == 0 or poses.shape != (len(own), 3):
        raise InvalidInputError(
            f"trajectory has {len(own)} stamps and poses of shape {poses.shape}, expected (K, 3)"
        )
    if (np.diff(own) <= 0).any():
        raise InvalidInputError("trajectory's stamps do not rise")
    stamps_ns = np.asarray(stamps_ns)
    # Relative to the start: nanoseconds since 1970 do not fit a double.
    at, own_s = (stamps_ns - own[0]).astype(np.float64), (own - own[0]).astype(np.float64)
    is_inside = (stamps_ns >= own[0]) & (stamps_ns <= own[-1])
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    found = np.stack([np.interp(at, own_s, column) for column in columns], axis=-1)
    found[:, 2] = wrap_angle(found[:, 2])
    found[~is_inside] = np.nan
    return found, is_inside


def trajectory_error(
    estimate: Mapping[str, Trajectory], truth: Mapping[str, Trajectory]
) -> TrajectoryError:
    """Compare all vehicles' trajectories, in one frame, with the truth.

    The truth is interpolated at the estimate's times; poses outside its span are left out. One
    rigid motion for all vehicles together (`align_points` of the positions) takes the estimate's
    frame to the truth's: so vehicles that are wrong relative to each other count as wrong.

    Raises
    ------
    InvalidInputError
        If a vehicle has no truth, or no pose lies within the truth's span.
    """
    found, true, owners = [], [], []
    for vehicle in sorted(estimate):
        if vehicle not in truth:
            raise InvalidInputError(f"vehicle {vehicle!r} has no true trajectory")
        stamps_ns, poses = estimate[vehicle]
        expected, is_inside = interpolate_poses(truth[vehicle], stamps_ns)
        found.append(np.asarray(poses, dtype=np.float64)[is_inside])
        true.append(expected[is_inside])
        owners += [vehicle] * int(is_inside.sum())
    if not owners:
        raise InvalidInputError("no estimated pose lies within the time span of the truth")
    estimated, expected = np.concatenate(found), np.concatenate(true)
    T_truth_map = align_points(estimated[:, :2], expected[:, :2])
    distance = np.hypot(*(T_truth_map.apply(estimated[:, :2]) - expected[:, :2]).T)
    angle = wrap_angle(estimated[:, 2] + T_truth_map.yaw - expected[:, 2])
    names = np.array(owners)
    return TrajectoryError(
        T_truth_map,
        _rms(distance),
        float(np.median(distance)),
        float(distance.max()),
        _rms(angle),
        len(distance),
        {name: _rms(distance[names == name]) for name in sorted(set(owners))},
    )


def resample(
    occupancy: OccupancyMap, spec: GridSpec, T_frame_map: SE2 | None = None
) -> NDArray[np.int8]:
    """Values (spec.shape) of the nearest cell of a map; -1 outside.

    Parameters
    ----------
    occupancy
        The map.
    spec
        Where to look, in some frame.
    T_frame_map
        From the map's frame to that frame; default none.
    """
    own = occupancy.spec
    T_grids = own.T_frame_grid.inverse() @ (T_frame_map or SE2()).inverse() @ spec.T_frame_grid
    ratio = spec.resolution_m / own.resolution_m
    # Centres in the map's cells, as sums of a row's and a column's part: a pass over all cells
    # costs more than the arithmetic.
    steps_row, steps_col = (np.arange(count) + 0.5 for count in spec.shape)
    cos, sin = ratio * math.cos(T_grids.yaw), ratio * math.sin(T_grids.yaw)
    x_0, y_0 = T_grids.x / own.resolution_m, T_grids.y / own.resolution_m
    values = np.full(spec.shape, -1, dtype=np.int8)
    for strip, *_ in strips_of(spec.num_rows):
        steps = steps_row[strip, None]
        cols = np.floor((x_0 + cos * steps_col)[None] - sin * steps).astype(np.int32)
        rows = np.floor((y_0 + sin * steps_col)[None] + cos * steps).astype(np.int32)
        is_inside = (rows >= 0) & (rows < own.shape[0]) & (cols >= 0) & (cols < own.shape[1])
        values[strip][is_inside] = occupancy.values[rows[is_inside], cols[is_inside]]
    return values


def compare_maps(
    estimate: OccupancyMap,
    truth: OccupancyMap,
    T_truth_estimate: SE2 | None = None,
    *,
    tolerance_m: float = 0.0,
    region: BoolArray | None = None,
) -> MapError:
    """Compare a map with the true one, cell by cell on the true one's lattice.

    The lattice is the truth's, extended in whole cells until it also covers everything that the
    estimate knows, so that what was drawn in a wrong place counts. The estimate is looked up
    there by its nearest cell. As pictures, both hold the probability of being occupied in [0, 1],
    with unknown at 0.5.

    Parameters
    ----------
    estimate, truth
        The maps.
    T_truth_estimate
        From the estimate's frame to the truth's, as found by `trajectory_error`; default none.
    tolerance_m
        How far a wall may be from its partner in ``wall_iou_tolerant``, precision and recall [m].
    region
        Cells (truth.spec.shape) that count; default all. Nothing outside is looked at; the
        lattice is not extended then.

    Returns
    -------
    MapError
        mse: mean over cells of the squared difference of the pictures (Zhang et al. 2023, Figure
        9, there on 8-bit pictures: times 255^2).
        ssim: mean structural similarity, Gaussian-free window of 7 x 7 cells, data range 1 (Wang
        et al. 2004, as in scikit-image); 1 is equal.
        wall_iou: cells above 50 percent in both, over those in either; 1 where there are none.
        wall_iou_tolerant: m / (m + walls of the estimate without partner + walls of the truth
        without partner), with m the mean number of walls with a partner within the tolerance; for
        tolerance 0 this is wall_iou.
        wall_precision, wall_recall: share of the estimate's (truth's) walls with a partner; 1
        where there are none.
        coverage: share of the truth's known cells that the estimate knows.
    """
    T_truth_estimate = T_truth_estimate or SE2()
    spec = truth.spec
    if region is None:
        spec = _covering(truth.spec, estimate, T_truth_estimate)
    elif region.shape != spec.shape:
        raise InvalidInputError(f"region has shape {region.shape}, expected {spec.shape}")
    if min(spec.shape) < _SSIM_WINDOW:
        raise InvalidInputError(
            f"the maps cover {spec.shape} cells, expected at least {_SSIM_WINDOW} each way"
        )
    found = resample(estimate, spec, T_truth_estimate)
    true = truth.values if spec == truth.spec else resample(truth, spec)
    counts = np.ones(spec.shape, dtype=np.bool_) if region is None else region
    if not counts.any():
        raise InvalidInputError("region holds no cell, expected at least one")
    mse, ssim = _picture_errors(found, true, counts)
    walls, true_walls = (found > 50) & counts, (true > 50) & counts
    tolerance_cells = tolerance_m / spec.resolution_m
    has_partner = walls & _within(true_walls, tolerance_cells)
    is_found = true_walls & _within(walls, tolerance_cells)
    known = (true >= 0) & counts
    return MapError(
        mse=mse,
        ssim=ssim,
        wall_iou=_iou(walls, walls & true_walls, true_walls, walls & true_walls),
        wall_iou_tolerant=_iou(walls, has_partner, true_walls, is_found),
        wall_precision=_share(has_partner, walls),
        wall_recall=_share(is_found, true_walls),
        coverage=float((found[known] >= 0).mean()) if known.any() else 1.0,
    )


def map_sharpness(occupancy: OccupancyMap) -> MapSharpness:
    """Measure a map by itself: misplaced submaps blur walls, double them, contradict each other.

    Returns
    -------
    MapSharpness
        entropy_bits: mean over known cells of the binary entropy of the probability, in [0, 1]; 0
        is decided everywhere.
        wall_entropy_bits: the same over known cells within two cells of a wall (above 50 percent),
        where misplacement shows.
        wall_share: walls over known cells; of two maps of the same recording, the sharper one has
        less.
        wall_thickness_cells: walls over the cells of their skeleton; 1 is as thin as can be. NaN
        without walls.
    """
    known, walls = occupancy.known, occupancy.values > 50
    if not known.any():
        return MapSharpness(math.nan, math.nan, math.nan, math.nan)
    percent = np.clip(np.arange(101) / 100.0, 1e-12, 1.0 - 1e-12)
    of_percent = -(percent * np.log2(percent) + (1.0 - percent) * np.log2(1.0 - percent))
    entropy_bits = float(of_percent[occupancy.values[known]].mean())
    if not walls.any():
        return MapSharpness(entropy_bits, math.nan, 0.0, math.nan)
    near = known & _within(walls, 2.0)
    return MapSharpness(
        entropy_bits=entropy_bits,
        wall_entropy_bits=float(of_percent[occupancy.values[near]].mean()),
        wall_share=float(walls.sum() / known.sum()),
        wall_thickness_cells=float(walls.sum() / skeletonize(walls).sum()),
    )


def _picture_errors(
    found: NDArray[np.int8], true: NDArray[np.int8], counts: BoolArray
) -> tuple[float, float]:
    """Mean squared difference and mean structural similarity of two maps as pictures."""
    chosen, margin = _interior(counts), _SSIM_WINDOW // 2
    squares = similarities = 0.0
    for strip, around, inside in strips_of(len(found), margin):
        picture, true_picture = _picture(found[around]), _picture(true[around])
        _, similarity = structural_similarity(
            picture, true_picture, win_size=_SSIM_WINDOW, data_range=1.0, full=True
        )
        difference = (picture - true_picture)[inside][counts[strip]]
        squares += float((difference**2).sum())
        similarities += float(similarity[inside][chosen[strip]].sum())
    return squares / int(counts.sum()), similarities / int(chosen.sum())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _picture(values: NDArray[np.int8]) -> FloatArray:
    return np.where(values < 0, 0.5, values / 100.0)


def _covering(spec: GridSpec, other: OccupancyMap, T_frame_other: SE2) -> GridSpec:
    """Extend a grid by whole cells to cover all that another map knows."""
    known = ends_of_rows(other.known)
    if len(known) == 0:
        return spec
    cells = spec.cells_of(T_frame_other.apply(other.spec.centers_of(known)))
    low = np.minimum(cells.min(axis=0), 0)
    high = np.maximum(cells.max(axis=0) + 1, spec.shape)
    corner = spec.T_frame_grid @ SE2(low[1] * spec.resolution_m, low[0] * spec.resolution_m)
    num_rows, num_cols = (int(n) for n in high - low)
    if not low.any():
        corner = spec.T_frame_grid
    return GridSpec(spec.resolution_m, num_rows, num_cols, corner)


def ends_of_rows(mask: BoolArray) -> IntArray:
    """First and last cell (N, 2) of each row that has any: no other lies farther out."""
    rows = np.flatnonzero(mask.any(axis=1))
    first = mask[rows].argmax(axis=1)
    last = mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)
    return np.column_stack([np.tile(rows, 2), np.concatenate([first, last])])


def _interior(counts: BoolArray) -> BoolArray:
    """Cells whose whole window lies in the picture, as scikit-image averages; else all."""
    inner = np.zeros_like(counts)
    margin = _SSIM_WINDOW // 2
    inner[margin:-margin, margin:-margin] = counts[margin:-margin, margin:-margin]
    return inner if inner.any() else counts


def _within(walls: BoolArray, distance_cells: float) -> BoolArray:
    """Cells not farther than a distance from a wall."""
    if not walls.any():
        return np.zeros_like(walls)
    distance = cv2.distanceTransform((~walls).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Roots of whole numbers: the nearest two that differ are farther apart than this.
    return np.asarray(distance <= distance_cells + 1e-4)


def _share(part: BoolArray, whole: BoolArray) -> float:
    total = int(whole.sum())
    return float(part.sum()) / total if total else 1.0


def _iou(
    walls: BoolArray, matched: BoolArray, others: BoolArray, others_matched: BoolArray
) -> float:
    mean = 0.5 * (int(matched.sum()) + int(others_matched.sum()))
    union = mean + int((walls & ~matched).sum()) + int((others & ~others_matched).sum())
    return mean / union if union else 1.0
