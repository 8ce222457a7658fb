"""What is matched: maps fused from several submaps.

One short submap overlaps little with another; a map of neighbouring submaps gives the
registration more to hold on to.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap, SubmapId

__all__ = [
    "StoredSubmap",
    "SubmapGroup",
    "joint_box",
    "lattice_box",
    "render_group",
    "shared_area_m2",
]

FloatArray = NDArray[np.float64]

_MAX_FOOTPRINT_POINTS = 400
_MAX_ODOM_M = 1e7
"""No odometry frame of a vehicle is larger; the coordinates of a map projection fit in."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredSubmap:
    """A submap, checked, with what is often asked of it."""

    submap: Submap
    digest: bytes
    """Of the grid's content and place: equal grids match equally."""
    fingerprint: bytes
    """Of everything: tells a message sent twice from two messages under one name."""
    footprint: FloatArray
    """(K, 2) [m] in the submap's frame: known cells, evenly thinned."""
    area_per_point_m2: float
    radius_m: float
    """Farthest known cell from the submap's origin."""

    @classmethod
    def of(cls, submap: Submap, max_cells: int) -> StoredSubmap:
        """Check a submap.

        Raises
        ------
        InvalidInputError
            Naming the submap, the field, its value, and what was expected.
        """
        _check(submap, max_cells)
        spec, values = submap.grid.spec, submap.grid.values
        header = np.array([spec.resolution_m, *spec.shape, *spec.T_frame_grid.as_array()])
        digest = hashlib.blake2b(header.tobytes() + values.tobytes(), digest_size=16)
        everything = digest.copy()
        for part in (
            np.array([*submap.T_odom_submap.as_array(), submap.is_final, submap.stamp_ns]),
            np.asarray(submap.covariance, dtype=np.float64),
            np.asarray(submap.trajectory, dtype=np.float64),
        ):
            everything.update(np.ascontiguousarray(part).tobytes())
        kept, share = _thinned(submap.grid.known)
        footprint = spec.centers_of(kept) if len(kept) else np.empty((0, 2))
        radius_m = float(np.hypot(*footprint.T).max()) if len(kept) else 0.0
        area = spec.resolution_m**2 * share
        return cls(submap, digest.digest(), everything.digest(), footprint, area, radius_m)

    @property
    def area_m2(self) -> float:
        """Known area."""
        return len(self.footprint) * self.area_per_point_m2


@dataclass(frozen=True, slots=True, eq=False)
class SubmapGroup:
    """Submaps placed in the frame of one of them, the reference."""

    reference: SubmapId
    T_reference_submap: dict[SubmapId, SE2]
    key: bytes = field(default=b"")

    @classmethod
    def of(
        cls, members: Sequence[StoredSubmap], T_frame_submap: Sequence[SE2], reference: int
    ) -> SubmapGroup:
        """Place members by poses in any common frame; `reference` is an index."""
        T_reference_frame = T_frame_submap[reference].inverse()
        poses: dict[SubmapId, SE2] = {}
        hasher = hashlib.blake2b(digest_size=16)
        for index, (member, motion) in enumerate(zip(members, T_frame_submap, strict=True)):
            # Exactly nothing for the reference itself; elsewhere rounding errors are cut off.
            relative = SE2() if index == reference else T_reference_frame @ motion
            rounded = SE2.from_array(np.round(relative.as_array(), 6))
            poses[member.submap.submap_id] = rounded
            name = f"({member.submap.submap_id.stable_name}, {rounded!r})"
            hasher.update(name.encode() + member.digest)
        reference_id = members[reference].submap.submap_id
        hasher.update(reference_id.stable_name.encode())
        return cls(reference_id, poses, hasher.digest())

    @property
    def ids(self) -> tuple[SubmapId, ...]:
        """Members, in order."""
        return tuple(self.T_reference_submap)


def render_group(
    group: SubmapGroup, submaps: Mapping[SubmapId, StoredSubmap], log_odds_max: float
) -> OccupancyMap | None:
    """Fuse a group's submaps on the lattice of its reference; None where nothing was seen."""
    spec = submaps[group.reference].submap.grid.spec
    lattice = GridSpec(spec.resolution_m, 1, 1, spec.T_frame_grid)
    placed = [(submaps[i].submap.grid, T) for i, T in group.T_reference_submap.items()]
    return fuse_maps(lattice, placed, log_odds_max)


def lattice_box(lattice: GridSpec, spec: GridSpec, T_frame_submap: SE2) -> FloatArray:
    """Least and largest row and column (2, 2) of a lattice that a placed grid reaches."""
    T_lattice_grid = lattice.T_frame_grid.inverse() @ T_frame_submap @ spec.T_frame_grid
    corners = T_lattice_grid.apply(GridSpec(spec.resolution_m, *spec.shape).corners())
    cells: FloatArray = corners[:, ::-1] / lattice.resolution_m
    return np.array([cells.min(axis=0), cells.max(axis=0)])


def joint_box(boxes: Sequence[FloatArray]) -> FloatArray:
    """Box (2, 2) around boxes."""
    return np.array([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])


def shared_area_m2(source: StoredSubmap, target: StoredSubmap, T_target_source: SE2) -> float:
    """Area [m^2] that both submaps have seen."""
    if len(source.footprint) == 0 or len(target.footprint) == 0:
        return 0.0
    reach = source.radius_m + target.radius_m
    if math.hypot(T_target_source.x, T_target_source.y) > reach:
        return 0.0
    grid = target.submap.grid
    num = _num_known(
        source.footprint, _turn_and_shift(T_target_source),
        _turn_and_shift(grid.spec.T_frame_grid.inverse()), grid.spec.resolution_m, grid.values,
    )  # fmt: skip
    return num * source.area_per_point_m2


def _turn_and_shift(motion: SE2) -> tuple[float, float, float, float]:
    return math.cos(motion.yaw), math.sin(motion.yaw), motion.x, motion.y


@njit(cache=True, nogil=True)
def _num_known(points, T_target_source, T_grid_target, resolution_m, values):  # type: ignore[no-untyped-def]
    """How many points (K, 2) [m] lie on known cells; motions are (cos, sin, x, y)."""
    cos, sin, x_0, y_0 = T_target_source
    grid_cos, grid_sin, grid_x, grid_y = T_grid_target
    num_rows, num_cols = values.shape
    count = 0
    for k in range(points.shape[0]):
        x = cos * points[k, 0] - sin * points[k, 1] + x_0
        y = sin * points[k, 0] + cos * points[k, 1] + y_0
        col = math.floor((grid_cos * x - grid_sin * y + grid_x) / resolution_m)
        row = math.floor((grid_sin * x + grid_cos * y + grid_y) / resolution_m)
        if 0 <= row < num_rows and 0 <= col < num_cols and values[row, col] >= 0:
            count += 1
    return count


def _thinned(known: NDArray[np.bool_]) -> tuple[NDArray[np.int64], float]:
    """Known cells (K, 2) on a coarser grid, and how many original ones each stands for."""
    num_known = int(np.count_nonzero(known))
    if num_known <= _MAX_FOOTPRINT_POINTS:
        return np.argwhere(known), 1.0
    step = int(np.ceil(np.sqrt(num_known / _MAX_FOOTPRINT_POINTS)))
    first = -(step // 2) % step
    # Coarse first: the coordinates of all known cells take eight times the room of a grid.
    kept = np.argwhere(known[first::step, first::step]) * step + first
    if len(kept) == 0:
        kept = np.argwhere(known)[:: num_known // _MAX_FOOTPRINT_POINTS]
    return kept, num_known / len(kept)


def _check(submap: Submap, max_cells: int) -> None:
    name = f"submap {submap.submap_id}"
    if not submap.vehicle_id:
        raise InvalidInputError("submap has an empty vehicle_id, expected the vehicle's name")
    if submap.sequence < 0 or submap.revision < 0:
        raise InvalidInputError(
            f"{name}: sequence {submap.sequence}, revision {submap.revision}, expected >= 0"
        )
    if not 0 <= submap.run_id <= MAX_RUN_ID:
        raise InvalidInputError(f"{name}: run_id is {submap.run_id}, expected 0 to {MAX_RUN_ID}")
    covariance = np.asarray(submap.covariance)
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise InvalidInputError(f"{name}: covariance is {covariance}, expected (3, 3) finite")
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12):
        raise InvalidInputError(f"{name}: covariance is {covariance}, expected symmetric")
    lowest = float(np.linalg.eigvalsh(covariance)[0])
    if lowest < -1e-9 * max(1.0, float(np.abs(covariance).max())):
        raise InvalidInputError(f"{name}: covariance has eigenvalue {lowest:g}, expected >= 0")
    away_m = max(abs(submap.T_odom_submap.x), abs(submap.T_odom_submap.y))
    if not away_m <= _MAX_ODOM_M:
        raise InvalidInputError(
            f"{name}: its pose lies {away_m:g} m from odom's origin, expected at most "
            f"{_MAX_ODOM_M:g} m"
        )
    if submap.grid.values.size > max_cells:
        raise InvalidInputError(
            f"{name}: the grid has {submap.grid.values.size} cells, expected at most {max_cells}"
        )
    shape, stamps = np.shape(submap.trajectory), np.shape(submap.trajectory_stamp_ns)
    if len(shape) != 2 or shape[1] != 3 or stamps != shape[:1]:
        raise InvalidInputError(
            f"{name}: trajectory has shape {shape} and its stamps {stamps}, expected (K, 3), (K,)"
        )
    if not np.isfinite(submap.trajectory).all():
        raise InvalidInputError(f"{name}: trajectory holds a value that is not finite")
