import numpy as np

from uw_dslam_ros2.io.readings import FixEvent


def test_a_satellite_fix_becomes_metres_east_and_north():
    # One arc second of latitude is 30.9 m, one of longitude 30.9 m times cos(60 degrees).
    fix = FixEvent("auv_1", 0, "gps", np.array([60.0, 10.0]) + 1.0 / 3600.0, None, True)
    np.testing.assert_allclose(fix.position_m((60.0, 10.0)), [15.5, 30.95], atol=0.05)
    acoustic = FixEvent("auv_1", 0, "map", np.array([3.0, 4.0]), None)
    assert acoustic.position_m((60.0, 10.0)).tolist() == [3.0, 4.0]
