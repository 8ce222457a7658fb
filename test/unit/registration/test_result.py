"""The one form of a refusal."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    Progress,
    RegistrationResult,
    Verdict,
)
from uw_dslam_ros2.core.se2 import SE2


@pytest.mark.parametrize("verdict", [v for v in Verdict if v is not Verdict.ACCEPTED])
def test_a_refusal_makes_nothing_up(verdict):
    refused = RegistrationResult.refused(verdict, "because", num_points=(3, 4))
    assert (refused.verdict, refused.reason) == (verdict, "because")
    assert not refused.is_accepted
    assert not refused.is_certified
    assert refused.T_target_source is None
    assert np.isnan(refused.covariance).all()
    assert refused.probability == 0.0
    unknown = ("score", "seconds", "overlap", "conflict_ratio", "inlier_ratio")
    assert all(math.isnan(getattr(refused, name)) for name in unknown)
    assert (refused.lower_bound, refused.upper_bound, refused.gap) == (0.0, 1.0, 1.0)
    assert (refused.num_source_points, refused.num_target_points) == (3, 4)


def test_a_stopped_search_keeps_what_it_had():
    best = Progress("search", 0.25, 0.75, 100, 7, SE2(1.0, 2.0, 0.5))
    refused = RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "cancelled", best_so_far=best)
    assert refused.T_target_source == best.T_target_source
    assert (refused.score, refused.lower_bound, refused.upper_bound) == (0.25, 0.25, 0.75)
    assert refused.num_boxes == 100
    assert np.isnan(refused.covariance).all()


def test_nothing_is_accepted_as_a_refusal():
    with pytest.raises(ValueError, match="ACCEPTED"):
        RegistrationResult.refused(Verdict.ACCEPTED, "because")


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["half_width_m", "half_width_rad"])
def test_a_window_without_size_is_refused_by_name(name, bad):
    with pytest.raises(InvalidInputError, match=f"{name} is {bad}"):
        PriorWindow(SE2(), **{"half_width_m": 1.0, "half_width_rad": 0.1, name: bad})
