"""DVLs whose frame is not what their messages or transforms say."""

import numpy as np
import pytest

from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.doctor.judging.climb import Climb

UPRIGHT = np.diag([1.0, -1.0, -1.0])
AS_A_SONAR = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("mounting", "velocity", "is_told"),
    [
        (UPRIGHT, (0.8, 0.1, 0.1), False),
        (UPRIGHT, (0.2, 0.1, 0.2), False),  # it climbs steeply
        (UPRIGHT, (0.0, 0.0, 0.05), False),  # it hovers
        (UPRIGHT, (np.nan, np.nan, np.nan), False),
        (AS_A_SONAR, (0.8, 0.1, 0.1), True),
    ],
)
def test_a_vehicle_that_only_climbs_has_a_dvl_in_another_frame(rng, mounting, velocity, is_told):
    climb = Climb()
    for _ in range(100):
        climb.add("auv_1/dvl", mounting @ (np.array(velocity) + rng.normal(0.0, 0.01, 3)))
    found = Examination()
    climb.tell(found)
    assert [f.kind for f in found.findings] == ["dvl_vertical"] * is_told
