"""Whose a factor is by how large it is: a unit of the DVL, or a length of the sonar's bins."""

import numpy as np
import pytest

from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.doctor.judging.scales import judge_scale
from uw_dslam_ros2.core.doctor.motions.fits import VelocityFit


def judged(scale):
    found = Examination()
    judge_scale(found, VelocityFit(complex(scale), 0.002, is_mirrored=False, cost=np.empty(0)))
    return [finding.kind for finding in found.findings], found.conventions.changes()


@pytest.mark.parametrize("error", [0.982, 1.0, 1.015])
@pytest.mark.parametrize("unit", [0.001, 0.01, 0.5144, 1.0 / 3.6, 0.3048])
def test_a_factor_that_is_a_unit_is_the_dvls(unit, error):
    kinds, changes = judged(unit * error)
    assert kinds == ["dvl_unit"]
    assert changes == {"velocity_scale": pytest.approx(unit, rel=1e-3)}


@pytest.mark.parametrize("error", [0.98, 1.0])
@pytest.mark.parametrize("factor", [0.5, 2.0, 1.0 / 0.3048, 0.1, 10.0])
def test_ranges_in_another_unit_or_there_and_back_are_the_sonars(factor, error):
    kinds, changes = judged(factor * error)
    assert kinds == ["sonar_range_factor"]
    assert changes == {"sonar_range_scale": pytest.approx(1.0 / factor, rel=1e-3)}


@pytest.mark.parametrize("scale", [0.4, 1.5, 4.0])
def test_any_other_factor_is_that_of_a_bin(scale):
    kinds, changes = judged(scale)
    assert kinds == ["sonar_range_factor"]
    assert changes == {"sonar_range_scale": pytest.approx(1.0 / scale, rel=1e-3)}


@pytest.mark.parametrize("scale", [1e-3 * 1.06, 1e-3 / 1.06, 0.05, 8.0, 300.0])
def test_no_sonar_is_wrong_by_a_factor_that_only_a_unit_has(scale):
    kinds, changes = judged(scale)
    assert kinds == ["dvl_unit"]
    assert changes == {"velocity_scale": pytest.approx(scale, rel=1e-3)}
