"""When the vehicles have come to rest."""

from uw_dslam_ros2.ros.plumbing.arrivals import Arrivals


def test_nothing_is_expected_before_the_first_and_after_the_last():
    arrivals = Arrivals(5.0)
    assert not arrivals.is_growing(0.0)
    arrivals.note(10.0)
    assert arrivals.is_growing(14.9)
    assert not arrivals.is_growing(15.1)
    arrivals.note(20.0)
    arrivals.end()
    assert not arrivals.is_growing(20.0)
    arrivals.note(21.0)
    assert arrivals.is_growing(21.0)


def test_patience_follows_the_rhythm_within_its_limits():
    arrivals = Arrivals(0.0)
    for second in (0.0, 0.1, 0.2):
        arrivals.note(second)
    assert arrivals.is_growing(3.1)
    assert not arrivals.is_growing(3.3)
    arrivals.note(20.2)
    assert arrivals.is_growing(20.2 + 39.0)
    assert not arrivals.is_growing(20.2 + 41.0)
    arrivals.note(1000.0)
    assert not arrivals.is_growing(1000.0 + 121.0)
