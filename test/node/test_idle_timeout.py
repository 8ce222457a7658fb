"""When the vehicles have come to rest."""

from uw_dslam_ros2.ros.plumbing.idle_timeout import IdleTimeout


def test_nothing_is_expected_before_the_first_and_after_the_last():
    timeout = IdleTimeout(5.0)
    assert not timeout.is_active(0.0)
    timeout.note(10.0)
    assert timeout.is_active(14.9)
    assert not timeout.is_active(15.1)
    timeout.note(20.0)
    timeout.end()
    assert not timeout.is_active(20.0)
    timeout.note(21.0)
    assert timeout.is_active(21.0)


def test_patience_follows_the_rhythm_within_its_limits():
    timeout = IdleTimeout(0.0)
    for second in (0.0, 0.1, 0.2):
        timeout.note(second)
    assert timeout.is_active(3.1)
    assert not timeout.is_active(3.3)
    timeout.note(20.2)
    assert timeout.is_active(20.2 + 39.0)
    assert not timeout.is_active(20.2 + 41.0)
    timeout.note(1000.0)
    assert not timeout.is_active(1000.0 + 121.0)
