"""The true pose is not lost between the lattice that is scanned and the cells of the maps."""

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids import register
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.finding import candidates
from uw_dslam_ros2.core.registration.grids.finding.candidates import log_volume, scan_candidates
from uw_dslam_ros2.core.registration.grids.finding.frames import GridFrames
from uw_dslam_ros2.core.registration.grids.finding.landscape import Landscape
from uw_dslam_ros2.core.registration.grids.finding.search import whole_plane
from uw_dslam_ros2.core.registration.grids.preparation import prepare_maps
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.sim.maps.pairs import MapPair, cut_pair, is_right


def _thin_walled_place(size: int, spacing: int, rng: np.random.Generator) -> np.ndarray:
    """Pieces of walls one cell thick, along lines ``spacing`` cells apart on average."""
    values = np.zeros((size, size), np.int8)
    for image in (values, values.T):
        lines = np.cumsum(rng.integers(spacing // 2, spacing * 3 // 2, 2 * size // spacing))
        for line in lines[lines < size]:
            ends = np.sort(rng.integers(0, size, size // spacing // 2 * 2))
            for first, last in zip(ends[::2], ends[1::2], strict=True):
                image[line, first:last] = 100
    return values


def _thin_walled_pair(seed: int) -> MapPair:
    """Windows of 260 cells, whose lattice of 65 cells has three for each room."""
    rng = np.random.default_rng(seed)
    values = _thin_walled_place(624, 14, rng)
    return cut_pair(values, values, "thin walls", 0.5, "clean", rng)


@pytest.fixture(scope="module", params=[1, 2])
def thin_walled(request) -> MapPair:
    return _thin_walled_pair(request.param)


def test_the_true_pose_is_a_candidate_among_thin_walls(thin_walled):
    pair, config = thin_walled, GridRegistrationConfig()
    pyramid, _ = prepare_maps(pair.source, pair.target, config)
    found, _ = scan_candidates(pyramid, whole_plane(pyramid.scanned))
    frames = GridFrames(pair.source.spec, pair.target.spec)
    T_found = [frames.to_frames(pyramid.searched.motion_of(c.pose)) for c in found]
    assert any(is_right(pair, T) for T in T_found)


def test_evidence_finds_the_true_pose_among_thin_walls(monkeypatch):
    # Mirrors and symmetries take two thirds of the time, and move no pose.
    monkeypatch.setattr(register, "_LOOK_FOR_DOUBTS", 2.0)
    found = []
    for seed in range(1, 5):
        pair = _thin_walled_pair(seed)
        _, poses = match_evidence(pair.source, pair.target)
        found.append(is_right(pair, poses[0][1]))
    assert sum(found) >= 3, found  # 28 of 30 seeds


def test_a_small_map_in_a_large_one_keeps_cells():
    """Little is left of a window on the lattice of a map fifteen times as large."""
    rng = np.random.default_rng(5)
    values = _thin_walled_place(1500, 200, rng)
    whole = OccupancyMap(GridSpec(0.05, 1500, 1500), values)
    part = OccupancyMap(GridSpec(0.05, 100, 100), values[800:900, 700:800])
    pyramid, _ = prepare_maps(part, whole, GridRegistrationConfig())
    assert np.ptp(pyramid.searched.source_points, axis=0).max() > 24


def test_poses_are_counted_in_units_however_fine_the_scan(thin_walled):
    pyramid, _ = prepare_maps(thin_walled.source, thin_walled.target, GridRegistrationConfig())
    scanned, plane = pyramid.scanned, whole_plane(pyramid.scanned)
    assert scanned.resolution_m < 0.2
    assert scanned.resolution_m * pyramid.unit_cells == pytest.approx(0.2)  # 65 of 260 cells
    sizes_m = 2.0 * plane.half * (scanned.radius, 1.0, 1.0) * scanned.resolution_m
    assert log_volume(pyramid, plane) == pytest.approx(np.log(sizes_m / 0.2).sum())


def test_where_no_other_pose_is_known_nothing_stands_out():
    pose = np.array([[0.1, 4.0, 5.0]])
    landscape = Landscape(pose, np.array([0.7]), pose, np.array([0.7]))
    chance = candidates._background(candidates.Candidate(pose[0], 0.7), landscape, 20.0)
    assert chance.surprise(0.7) == 0.0
