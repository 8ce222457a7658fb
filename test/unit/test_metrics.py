"""Metrics against values worked out by hand, and against slower ways."""

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.metrics import (
    align_points,
    compare_maps,
    interpolate_poses,
    map_sharpness,
    resample,
    trajectory_error,
)
from uw_dslam_ros2.core.se2 import SE2

SECOND = 1_000_000_000


def track(poses, start_s=0):
    stamps_ns = (start_s + np.arange(len(poses))) * SECOND
    return stamps_ns, np.array(poses, dtype=float)


def occupancy(values, resolution_m=1.0, T_frame_grid=SE2()):
    values = np.array(values, dtype=np.int8)
    return OccupancyMap(GridSpec(resolution_m, *values.shape, T_frame_grid), values)


def padded(values, size=9):
    grid = np.zeros((size, size), dtype=np.int8)
    values = np.array(values)
    grid[: values.shape[0], : values.shape[1]] = values
    return grid


def test_a_planted_motion_is_found_exactly():
    points = np.random.default_rng(1).normal(size=(20, 2))
    motion = SE2(3.0, -1.0, 2.5)
    found = align_points(points, motion.apply(points))
    np.testing.assert_allclose(found.as_array(), motion.as_array(), atol=1e-12)


def test_alignment_is_no_worse_than_any_motion_nearby():
    rng = np.random.default_rng(2)
    source, target = rng.normal(size=(2, 12, 2))
    best = align_points(source, target)
    cost = np.sum((best.apply(source) - target) ** 2)
    for nudge in rng.normal(scale=0.05, size=(200, 3)):
        moved = SE2.from_array(best.as_array() + nudge)
        assert np.sum((moved.apply(source) - target) ** 2) >= cost


def test_alignment_of_one_point_is_a_shift_and_of_nothing_an_error():
    assert align_points([[1.0, 2.0]], [[4.0, 0.0]]) == SE2(3.0, -2.0, 0.0)
    with pytest.raises(InvalidInputError, match="expected \\(N > 0, 2\\)"):
        align_points(np.empty((0, 2)), np.empty((0, 2)))


def test_poses_between_two_stamps_go_the_short_way_round():
    trajectory = track(
        [[0.0, 0.0, math.pi - 0.1], [2.0, 4.0, -math.pi + 0.3]], start_s=1_700_000_000
    )
    stamps = trajectory[0][0] + np.array([-1, 0, SECOND // 2, SECOND, SECOND + 1])
    poses, is_inside = interpolate_poses(trajectory, stamps)
    assert is_inside.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(poses[2], [1.0, 2.0, -math.pi + 0.1], atol=1e-9)
    assert np.isnan(poses[[0, 4]]).all()


def test_stamps_must_rise():
    with pytest.raises(InvalidInputError, match="do not rise"):
        interpolate_poses((np.array([1, 1]), np.zeros((2, 3))), np.array([1]))


def test_error_is_zero_under_one_common_motion_and_not_under_two():
    truth = {"a": track([[0, 0, 0], [4, 0, 0]]), "b": track([[0, 3, 0], [4, 3, 0]])}
    motion = SE2(10.0, -5.0, 1.0)

    def moved(poses, motion):
        return np.array([(motion @ SE2.from_array(pose)).as_array() for pose in poses])

    common = {name: (stamps, moved(poses, motion)) for name, (stamps, poses) in truth.items()}
    result = trajectory_error(common, truth)
    assert result.rmse_m == pytest.approx(0.0, abs=1e-12)
    assert result.rmse_rad == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(result.T_truth_map.as_array(), motion.inverse().as_array())
    common["b"] = (truth["b"][0], moved(truth["b"][1], SE2(9.0, 0.0, 1.0)))
    assert trajectory_error(common, truth).rmse_m > 1.0


def test_error_of_two_points_by_hand():
    """Truth 2 m apart, estimate 4 m apart along the same line: each end is 1 m off."""
    result = trajectory_error(
        {"a": track([[0, 0, 0.0], [4, 0, 0.2]])}, {"a": track([[1, 0, 0.0], [3, 0, 0.0]])}
    )
    assert result.rmse_m == pytest.approx(1.0)
    assert result.median_m == pytest.approx(1.0)
    assert result.max_m == pytest.approx(1.0)
    assert result.rmse_rad == pytest.approx(math.sqrt(0.02))
    assert result.num_poses == 2
    assert result.per_vehicle_rmse_m == {"a": pytest.approx(1.0)}


def test_vehicles_without_truth_or_overlap_in_time_are_errors():
    with pytest.raises(InvalidInputError, match="'b' has no true"):
        trajectory_error({"b": track([[0, 0, 0]])}, {"a": track([[0, 0, 0]])})
    with pytest.raises(InvalidInputError, match="time span"):
        trajectory_error({"a": track([[0, 0, 0]], start_s=9)}, {"a": track([[0, 0, 0]])})


def test_resampling_a_hand_written_map_by_a_quarter_turn():
    # Row 0 is the lowest y. A quarter turn takes +x to +y: columns become rows.
    source = occupancy([[1, 2, 3], [4, 5, 6]])
    turned = resample(source, GridSpec(1.0, 3, 2, SE2(-2.0, 0.0)), SE2(0.0, 0.0, math.pi / 2))
    np.testing.assert_array_equal(turned, [[4, 1], [5, 2], [6, 3]])


def test_equal_maps_are_perfect():
    values = np.random.default_rng(0).choice([-1, 0, 100], size=(12, 15)).astype(np.int8)
    result = compare_maps(occupancy(values), occupancy(values))
    assert result.mse == 0.0
    assert result.ssim == pytest.approx(1.0)
    assert (result.wall_iou, result.wall_iou_tolerant, result.coverage) == (1.0, 1.0, 1.0)


def test_counts_by_hand():
    """Truth: walls in 4 cells of a row; estimate: two of them, one beside, one known less."""
    truth = padded([[100, 100, 100, 100]])
    found = padded([[100, 100, 0, 0, 0, 100]])
    found[8, 8] = -1
    result = compare_maps(occupancy(found), occupancy(truth), tolerance_m=1.0)
    # Three cells are wrong by 1, one unknown against free by 0.5, of 81.
    assert result.mse == pytest.approx((3 + 0.25) / 81)
    assert result.wall_iou == pytest.approx(2 / 5)
    # Within one cell: truth's third wall has a partner (the second), its fourth none; the
    # estimate's stray wall is two cells from the fourth.
    assert result.wall_recall == pytest.approx(3 / 4)
    assert result.wall_precision == pytest.approx(2 / 3)
    assert result.wall_iou_tolerant == pytest.approx(2.5 / (2.5 + 1 + 1))
    assert result.coverage == pytest.approx(80 / 81)


def test_what_lies_outside_the_truth_counts():
    truth = occupancy(padded([[100]]))
    stray = occupancy(padded([[100]]), T_frame_grid=SE2(-9.0, 0.0))
    result = compare_maps(stray, truth)
    # 9 x 18 cells: left half known by the estimate alone, right half by the truth alone.
    assert result.mse == pytest.approx(0.25)
    assert result.wall_iou == 0.0
    assert result.coverage == 0.0


def test_alignment_is_honoured():
    values = np.random.default_rng(3).choice([-1, 0, 100], size=(14, 14)).astype(np.int8)
    truth = occupancy(values, 0.5)
    T_truth_estimate = SE2(3.0, -2.0, math.pi / 2)
    shifted = OccupancyMap(
        GridSpec(0.5, 14, 14, T_truth_estimate.inverse() @ truth.spec.T_frame_grid), values
    )
    assert compare_maps(shifted, truth, T_truth_estimate).mse == 0.0
    assert compare_maps(shifted, truth).mse > 0.05


def test_ssim_is_scikit_images():
    rng = np.random.default_rng(4)
    a, b = (rng.choice([-1, 0, 30, 100], size=(20, 25)).astype(np.int8) for _ in range(2))
    pictures = [np.where(v < 0, 0.5, v / 100.0) for v in (a, b)]
    expected = structural_similarity(*pictures, data_range=1.0)
    assert compare_maps(occupancy(a), occupancy(b)).ssim == pytest.approx(expected)


def test_a_region_limits_what_counts():
    truth, found = padded([[100]]), padded([[0]])
    found[8, 8] = 100
    region = np.zeros((9, 9), dtype=bool)
    region[4:, 4:] = True
    result = compare_maps(occupancy(found), occupancy(truth), region=region)
    assert result.mse == pytest.approx(1 / 25)
    assert result.wall_precision == 0.0
    assert result.wall_recall == 1.0
    with pytest.raises(InvalidInputError, match="region has shape"):
        compare_maps(occupancy(found), occupancy(truth), region=np.ones((2, 2), dtype=bool))
    with pytest.raises(InvalidInputError, match="region holds no cell"):
        compare_maps(occupancy(found), occupancy(truth), region=~np.ones((9, 9), dtype=bool))


def test_maps_too_small_for_ssim_are_refused():
    with pytest.raises(InvalidInputError, match="at least 7"):
        compare_maps(occupancy([[0]]), occupancy([[0]]))


def test_entropy_by_hand():
    result = map_sharpness(occupancy([[50, 0, -1], [0, 100, -1]]))
    assert result.entropy_bits == pytest.approx(0.25, abs=1e-6)
    assert result.wall_share == pytest.approx(0.25)


def test_a_blurred_wall_is_thicker_and_less_certain():
    crisp = np.zeros((20, 20), dtype=np.int8)
    crisp[10, 3:17] = 100
    blurred = np.zeros((20, 20), dtype=np.int8)
    blurred[9:12, 3:17] = 70
    sharp, soft = map_sharpness(occupancy(crisp)), map_sharpness(occupancy(blurred))
    assert sharp.wall_thickness_cells == 1.0
    assert soft.wall_thickness_cells > 2.0
    assert soft.wall_entropy_bits > sharp.wall_entropy_bits
    assert soft.entropy_bits > sharp.entropy_bits


def test_a_map_of_nothing_has_no_sharpness():
    assert math.isnan(map_sharpness(occupancy([[-1, -1]])).entropy_bits)
    assert map_sharpness(occupancy([[0, 0]])).wall_share == 0.0


@pytest.mark.parametrize("num_rows", [7, 256, 257, 600])
def test_a_large_map_is_compared_in_strips_as_if_at_once(rng, num_rows):
    spec = GridSpec(0.1, num_rows, 40, SE2(1.0, -2.0, 0.3))
    one, other = (rng.integers(-1, 101, spec.shape).astype(np.int8) for _ in range(2))
    found = compare_maps(OccupancyMap(spec, one), OccupancyMap(spec, other))
    pictures = [np.where(values < 0, 0.5, values / 100.0) for values in (one, other)]
    assert found.mse == pytest.approx(np.mean((pictures[0] - pictures[1]) ** 2), rel=1e-12)
    expected = structural_similarity(*pictures, win_size=7, data_range=1.0)
    assert found.ssim == pytest.approx(expected, abs=1e-9)
