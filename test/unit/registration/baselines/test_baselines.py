"""The other methods: each finds what it can find, and their bounds are bounds."""

import math

import numpy as np
import pytest
from closeness import are_near

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.metrics import resample
from uw_dslam_ros2.core.registration.baselines import (
    PEERS,
    akaze_ransac,
    available_peers,
    correlative,
    fourier_mellin,
    go_icp,
    hough_spectrum,
    icp,
    many_start_icp,
    ndt,
    orb_ransac,
    pair_voting,
    procrustes,
)
from uw_dslam_ros2.core.registration.baselines.correlative import _pyramid
from uw_dslam_ros2.core.registration.baselines.ndt import _cells, _derivatives
from uw_dslam_ros2.core.registration.baselines.peers import _flattened, _lifted
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.point_sets import outlier_problem, overlap_problem

pytestmark = pytest.mark.kernels

GLOBAL = [many_start_icp, correlative, pair_voting, go_icp]
LOCAL = [icp, ndt]


@pytest.mark.parametrize("matcher", GLOBAL)
@pytest.mark.parametrize("seed", range(4))
def test_global_methods_recover_any_motion(matcher, seed):
    problem = outlier_problem(40, 0.33, seed=seed)
    found = matcher(problem.source, problem.target)
    error_m, error_rad = found.T_target_source.distance_to(problem.T_target_source)
    assert error_m < 1e-6
    assert error_rad < 1e-6


@pytest.mark.parametrize("matcher", [icp, ndt])
def test_local_methods_need_a_start_near_by(matcher, rng):
    """From close by they converge; a half turn away they do not."""
    outline = np.concatenate([np.linspace([-1, -0.6], [1, -0.6], 60),
                              np.linspace([1, -0.6], [1, 0.9], 50),
                              np.linspace([1, 0.9], [0.2, 0.3], 30)])  # fmt: skip
    source = outline + 0.003 * rng.standard_normal(outline.shape)
    T_target_source = SE2(0.06, -0.04, 0.05)
    target = T_target_source.apply(outline)
    near = matcher(source, target)
    assert are_near(near.T_target_source, T_target_source, 0.02, 0.02)
    far = matcher(source, target, T_initial=SE2(0.0, 0.0, math.pi))
    assert far.T_target_source.distance_to(T_target_source)[1] > 1.0
    assert far.score < near.score


@pytest.mark.parametrize("matcher", [*GLOBAL, *LOCAL])
def test_equal_input_gives_equal_output(matcher):
    problem = outlier_problem(25, 0.5, 0.02, seed=5)
    first, again = (matcher(problem.source, problem.target) for _ in range(2))
    assert first == again


@pytest.mark.parametrize("matcher", [*GLOBAL, *LOCAL])
def test_bad_points_are_refused(matcher):
    with pytest.raises(InvalidInputError, match="source"):
        matcher(np.zeros((0, 2)), np.zeros((3, 2)))
    with pytest.raises(InvalidInputError, match="target"):
        matcher(np.zeros((3, 2)), [[0.0, math.inf]])


@pytest.mark.parametrize("matcher", [many_start_icp, correlative, go_icp])
def test_a_search_lays_one_point_on_the_other(matcher):
    found = matcher([[0.3, 0.4]], [[-1.0, 2.0]])
    np.testing.assert_allclose(found.T_target_source.apply([[0.3, 0.4]]), [[-1.0, 2.0]])


def test_one_point_each_is_too_few_for_the_others():
    """Pairs and cells want more points; ICP stays at its start, where it has no pair to use."""
    for matcher in (pair_voting, ndt):
        assert matcher([[0.3, 0.4]], [[-1.0, 2.0]]).T_target_source is None
    start = SE2(0.1, 0.2, 0.3)
    assert icp([[0.3, 0.4]], [[-1.0, 2.0]], T_initial=start).T_target_source == start


def test_go_icp_leaves_out_what_has_no_counterpart():
    problem = overlap_problem(30, 0.7, seed=2)
    found = go_icp(problem.source, problem.target, trim=0.3)
    error_m, error_rad = found.T_target_source.distance_to(problem.T_target_source)
    assert error_m < 0.01  # 0.006 m and 0.05 degrees were seen
    assert error_rad < math.radians(0.2)


def test_pyramid_holds_maxima_of_windows(rng):
    pyramid = _pyramid(rng.uniform(-1, 1, (12, 2)), np.array([-1.2, -1.2]), np.ones(2), 0.05, 0.05)
    base = pyramid[0]
    for level in range(1, len(pyramid)):
        width = 1 << level
        for row, col in rng.integers(0, base.shape, (50, 2)):
            assert pyramid[level, row, col] == base[row : row + width, col : col + width].max()


def test_correlative_score_is_that_of_an_exhaustive_scan(rng):
    """Branch and bound over the pyramid finds the best cell that trying all of them finds."""
    source, target = rng.uniform(-0.3, 0.3, (6, 2)), rng.uniform(-0.3, 0.3, (8, 2))
    pitch, kernel = 0.05, 0.05
    found = correlative(source, target, kernel_m=kernel, pitch_m=pitch)
    border = 4 * kernel + pitch
    low, high = target.min(axis=0) - border, target.max(axis=0) + border
    base = _pyramid(target, low, high, kernel, pitch)[0]
    origin = low - 32 * pitch - (low + high) / 2
    points = source - (source.min(axis=0) + source.max(axis=0)) / 2
    reach = np.linalg.norm(points, axis=1).max()
    half = math.ceil(((high - low).max() / 2 + reach) / pitch)
    best = 0.0
    padded = np.pad(base, 3 * half)
    for angle in np.arange(0, 2 * math.pi, min(pitch / reach, math.pi / 8)):
        cells = np.floor((SE2(yaw=float(angle)).apply(points) - origin) / pitch).astype(int)
        for row in range(-half, half):
            for col in range(-half, half):
                r, c = cells[:, 1] + row + 3 * half, cells[:, 0] + col + 3 * half
                best = max(best, padded[r, c].sum())
    assert found.score == pytest.approx(best / len(source), rel=1e-6)


def test_ndt_derivatives_are_those_of_its_score(rng):
    target = rng.uniform(-1, 1, (60, 2))
    source = rng.uniform(-1, 1, (20, 2))
    cells = _cells(target, 0.8)
    pose = np.array([0.1, -0.2, 0.3])
    _, gradient, hessian = _derivatives(source, pose, cells, 0.8)
    step = 1e-6  # small enough that no point changes its cell here
    for k in range(3):
        shift = step * np.eye(3)[k]
        high, low = (_derivatives(source, pose + s * shift, cells, 0.8) for s in (1, -1))
        assert gradient[k] == pytest.approx((high[0] - low[0]) / (2 * step), rel=1e-5, abs=1e-6)
        np.testing.assert_allclose(
            hessian[k], (high[1] - low[1]) / (2 * step), rtol=1e-4, atol=1e-4
        )


def test_procrustes_is_exact_and_least_squares(rng):
    T_target_source = SE2(3.0, -2.0, 2.5)
    source = rng.uniform(-1, 1, (10, 2))
    found = procrustes(source, T_target_source.apply(source))
    assert are_near(found, T_target_source, 1e-12, 1e-12)
    target = T_target_source.apply(source) + 0.1 * rng.standard_normal(source.shape)
    best = procrustes(source, target)
    cost = np.sum((best.apply(source) - target) ** 2)
    for _ in range(100):
        other = SE2(*(best.as_array() + 0.01 * rng.standard_normal(3)).tolist())
        assert np.sum((other.apply(source) - target) ** 2) >= cost


def rooms(T_frame_grid=SE2()):
    """A small floor plan with walls that ORB can tell apart, 0.05 m cells."""
    rng = np.random.default_rng(7)
    values = np.full((200, 240), 0, dtype=np.int8)
    for _ in range(25):
        row, col = rng.integers(10, 180), rng.integers(10, 220)
        height, width = rng.integers(3, 25, 2)
        values[row : row + height, col : col + 3] = 100
        values[row : row + 3, col : col + width] = 100
    values[:, :8] = -1
    return OccupancyMap(GridSpec(0.05, *values.shape, T_frame_grid), values)


def test_orb_ransac_finds_the_shift_of_a_map():
    """The same cells at another origin: the motion is the quotient of the origins, by hand."""
    source, target = rooms(SE2(1.0, 2.0, 0.0)), rooms(SE2(-4.0, 0.5, 0.3))
    found = orb_ransac(source, target)
    expected = SE2(-4.0, 0.5, 0.3) @ SE2(1.0, 2.0, 0.0).inverse()
    assert are_near(found.T_target_source, expected, 1e-3, 1e-3)
    assert found.diagnostics["scale"] == pytest.approx(1.0, abs=1e-6)


def test_orb_ransac_on_an_empty_map_finds_nothing():
    blank = OccupancyMap(GridSpec(0.05, 100, 100), np.full((100, 100), -1, dtype=np.int8))
    assert orb_ransac(blank, rooms()).T_target_source is None
    coarse = OccupancyMap(GridSpec(0.1, 100, 100), np.full((100, 100), -1, dtype=np.int8))
    with pytest.raises(InvalidInputError, match="resolution"):
        orb_ransac(coarse, rooms())


@pytest.mark.parametrize("method", [akaze_ransac, fourier_mellin, hough_spectrum])
@pytest.mark.parametrize("yaw", [0.4, 2.5])
def test_methods_on_images_find_a_turned_map(method, yaw):
    """The same cells, drawn anew in a frame that is turned: right to a degree and some cells."""
    source = rooms(SE2(1.0, 2.0, 0.0))
    spec = GridSpec(0.05, 330, 330, SE2(-4.0, 0.5, 0.0))
    middle = SE2(*spec.T_frame_grid.apply(np.array([8.0, 8.0])).tolist())
    own = SE2(*source.spec.corners().mean(axis=0).tolist())
    expected = middle @ SE2(yaw=yaw) @ own.inverse()
    target = OccupancyMap(spec, resample(source, spec, expected))
    found = method(source, target)
    assert found.T_target_source is not None
    error_m = np.hypot(*(found.T_target_source.apply(own.as_array()[:2])
                         - expected.apply(own.as_array()[:2])))  # fmt: skip
    assert error_m < 0.25
    assert found.T_target_source.distance_to(expected)[1] < math.radians(1.0)


@pytest.mark.parametrize("method", [akaze_ransac, fourier_mellin, hough_spectrum])
def test_methods_on_images_find_nothing_in_an_empty_map(method):
    blank = OccupancyMap(GridSpec(0.05, 100, 100), np.full((100, 100), -1, dtype=np.int8))
    assert method(blank, rooms()).T_target_source is None
    coarse = OccupancyMap(GridSpec(0.1, 100, 100), np.full((100, 100), -1, dtype=np.int8))
    with pytest.raises(InvalidInputError, match="resolution"):
        method(coarse, rooms())


@pytest.mark.parametrize("name", list(PEERS))
def test_installed_peers_answer(name):
    matcher = available_peers().get(name)
    if matcher is None:
        pytest.skip(f"{PEERS[name][0]} is not installed (an optional peer)")
    problem = outlier_problem(60, 0.0, seed=1)
    T_small = SE2(0.02, 0.01, 0.02)
    found = matcher(problem.source, T_small.apply(problem.source))
    assert are_near(found.T_target_source, T_small, 1e-6, 1e-6)


def test_peers_see_the_plane_at_z_0_and_answer_in_it():
    np.testing.assert_array_equal(_lifted("source", [[1.0, 2.0]]), [[1.0, 2.0, 0.0]])
    # A quarter turn to the left, and 3 m up that the plane does not know.
    turned = [[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 1.0, 3.0], [0, 0, 0, 1.0]]
    assert are_near(_flattened(turned), SE2(5.0, 6.0, math.pi / 2.0), 1e-12, 1e-12)
    assert _flattened(np.diag([1.0, -1.0, -1.0, 1.0])) is None
    assert _flattened(np.full((4, 4), math.nan)) is None
