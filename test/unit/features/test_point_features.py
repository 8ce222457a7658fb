"""Algorithm 2 on points."""

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.clustering import cluster_filter, mean_spacing
from uw_dslam_ros2.core.features.sampling import sample_voxels, voxel_size


def test_mean_spacing_of_a_lattice_is_its_pitch():
    lattice = 0.25 * np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2)
    assert mean_spacing(lattice) == pytest.approx(0.25)
    assert voxel_size(lattice, 3.0) == pytest.approx(0.75)
    assert mean_spacing(lattice[:1]) == 0.0


def test_far_single_points_are_dropped_and_clusters_kept():
    rng = np.random.default_rng(1)
    clusters = np.vstack([rng.normal(c, 0.1, (40, 2)) for c in ([0.0, 0.0], [5.0, 1.0])])
    strays = np.array([[20.0, 0.0], [-15.0, 9.0], [3.0, -30.0]])
    keep = cluster_filter(np.vstack([clusters, strays]), radius_factor=10.0)
    assert keep[:80].all()
    assert not keep[80:].any()


def test_filter_does_not_care_about_units_or_order():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(60, 2)) ** 3
    keep, order = cluster_filter(points), rng.permutation(60)
    assert (cluster_filter(1000.0 * points) == keep).all()
    assert (cluster_filter(points[order]) == keep[order]).all()


@pytest.mark.parametrize("size", [0.1, 0.5, 3.0])
def test_one_point_of_every_voxel(size):
    points = np.random.default_rng(3).uniform(-2.0, 2.0, (500, 2))
    chosen = sample_voxels(points, size)
    cells = np.floor((points - points.min(axis=0)) / size).astype(int)
    assert len(np.unique(cells[chosen], axis=0)) == len(chosen)
    assert {tuple(cell) for cell in cells} == {tuple(cell) for cell in cells[chosen]}


def test_the_seed_decides_which_point():
    points = np.random.default_rng(4).uniform(size=(300, 2))
    assert (sample_voxels(points, 0.2, seed=7) == sample_voxels(points, 0.2, seed=7)).all()
    assert (sample_voxels(points, 0.2, seed=7) != sample_voxels(points, 0.2, seed=8)).any()


@pytest.mark.parametrize("num", [0, 1])
def test_next_to_nothing_stays_what_it_is(num):
    assert len(sample_voxels(np.zeros((num, 2)))) == num
    assert len(cluster_filter(np.zeros((num, 2)))) == num


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 3)), np.full((2, 2), np.nan)])
def test_bad_points_are_refused(bad):
    with pytest.raises(InvalidInputError):
        sample_voxels(bad, 1.0)
    with pytest.raises(InvalidInputError):
        cluster_filter(bad)


def _reachable(points, radius_m, min_size):
    """Clusters as their definition has it: grown from core points, one neighbour at a time."""
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= radius_m
    is_core = near.sum(axis=1) >= min_size
    found = is_core.copy()
    for index in np.flatnonzero(is_core):
        found |= near[index]
    return found


@pytest.mark.parametrize("min_size", [1, 3, 8])
@pytest.mark.parametrize("factor", [0.5, 2.0, 6.0])
def test_clusters_are_what_density_reaches(rng, factor, min_size):
    points = rng.normal(size=(200, 2)) ** 3
    expected = _reachable(points, factor * mean_spacing(points), min_size)
    keep = cluster_filter(points, radius_factor=factor, min_cluster_size=min_size)
    np.testing.assert_array_equal(keep, expected)
