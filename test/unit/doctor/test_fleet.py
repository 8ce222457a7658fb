"""Vehicles in one water have one speed of sound; a DVL's scale is its own."""

import itertools

import pytest

from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.doctor.examination import ScaleEstimate
from uw_dslam_ros2.core.doctor.fleet import share_sound_speed
from uw_dslam_ros2.core.doctor.judging.scales import judge_scale
from uw_dslam_ros2.core.doctor.motions.fits import VelocityFit


def examined(ratio, sigma=0.0025, vehicle_id="auv_1"):
    """As `examine` leaves it where the echoes move `ratio` times as far as the DVL says."""
    result = Examination(vehicle_id=vehicle_id)
    if ratio is not None:
        judge_scale(result, VelocityFit(complex(ratio), sigma, is_mirrored=False, cost=None))
    return result


def fleet(*ratios):
    return [examined(ratio, vehicle_id=f"auv_{i}") for i, ratio in enumerate(ratios, start=1)]


def scales(found):
    return [(own.conventions.sonar_range_scale, own.conventions.velocity_scale) for own in found]


def kinds(found):
    return [sorted(finding.kind for finding in own.findings) for own in found]


@pytest.mark.parametrize(
    "ratios", [(1.021,), (1.0, 1.015), (0.95, 1.0, 1.01), (1.03, None), (0.97, 0.95)]
)
def test_what_tells_nothing_of_a_common_speed_of_sound_stays(ratios):
    alone = fleet(*ratios)
    assert share_sound_speed(alone) == alone


@pytest.mark.parametrize("ratios", [(1.021, 1.004), (1.04, 1.023, 1.03), (1.025, None, 1.02)])
def test_all_are_read_with_the_mean_though_some_are_below_the_alarm(ratios):
    found = share_sound_speed(fleet(*ratios))
    ranges = {scale for scale, _ in scales(found)}
    assert len(ranges) == 1
    known = [1.0 / ratio for ratio in ratios if ratio is not None]
    assert min(known) < ranges.pop() < max(known)
    assert all(velocity == 1.0 for _, velocity in scales(found))
    assert all(own == ["sound_speed"] for own in kinds(found))


def test_a_ratio_that_is_known_better_counts_more():
    sure, unsure = examined(1.03, 0.002), examined(1.04, 0.02)
    found = share_sound_speed([sure, unsure])
    assert found[0].conventions.sonar_range_scale == pytest.approx(1.0 / 1.03, abs=0.002)


def test_a_dvl_of_wrong_scale_is_not_taken_for_the_water():
    found = share_sound_speed(fleet(1.0, 1.06, 1.004))
    assert scales(found) == [(1.0, 1.0), (1.0, 1.06), (1.0, 1.0)]
    assert kinds(found) == [[], ["dvl_scale"], []]


def test_one_vehicle_at_the_right_scale_speaks_for_the_water():
    found = share_sound_speed(fleet(1.06, 1.001))
    assert scales(found) == [(1.0, 1.06), (1.0, 1.0)]
    assert kinds(found) == [["dvl_scale"], []]


@pytest.mark.parametrize("odd", [1.15, 1.0, 0.95])
def test_a_dvl_of_wrong_scale_does_not_spoil_the_others(odd):
    found = share_sound_speed(fleet(1.04, odd, 1.042, 1.038))
    ranges = [scale for scale, _ in scales(found)]
    assert ranges == [pytest.approx(1.0 / 1.04, abs=0.001)] * 4
    velocity = [velocity for _, velocity in scales(found)]
    assert velocity == [1.0, pytest.approx(odd / 1.04, abs=0.002), 1.0, 1.0]
    assert "dvl_scale" in kinds(found)[1]


def test_those_that_all_contradict_each_other_stay():
    alone = fleet(1.05, 1.12)
    assert share_sound_speed(alone) == alone


def test_a_tilted_sonar_keeps_its_own_scale():
    tilted = Examination(vehicle_id="auv_3")
    judge_scale(tilted, VelocityFit(0.95 + 0j, 0.002, is_mirrored=False, cost=None), 0.3)
    assert tilted.scale is None
    found = share_sound_speed([*fleet(1.03, 1.028), tilted])
    assert found[2] is tilted
    assert found[0].conventions.sonar_range_scale < 1.0


@pytest.mark.parametrize("ratios", [(1.021, 1.004, None), (1.04, 1.0, 1.041), (1.06, 1.0, 1.12)])
def test_the_order_of_vehicles_does_not_matter(ratios):
    expected = {own.vehicle_id: own.conventions for own in share_sound_speed(fleet(*ratios))}
    for order in itertools.permutations(fleet(*ratios)):
        found = share_sound_speed(order)
        assert {own.vehicle_id: own.conventions for own in found} == expected
        assert [own.vehicle_id for own in found] == [own.vehicle_id for own in order]


def test_odometry_is_not_told_a_scale_that_it_has_not():
    odd = Examination(vehicle_id="auv_1", scale=ScaleEstimate(1.06, 0.002, "odometry"))
    odd.tell("sound_speed", "sonar", "its echoes move farther", sonar_range_scale=0.943)
    found = share_sound_speed([odd, *fleet(1.0)])
    assert found[0].conventions.velocity_scale == 1.0
