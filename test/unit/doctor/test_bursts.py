"""Bursts show the turns and the whole recording, and more of them are asked for where few tell."""

import numpy as np

from uw_dslam_ros2.core.doctor.bursts import choose_pings, more_bursts

PINGS_S = np.arange(0.0, 600.0, 0.33)
IMU_S = np.arange(0.0, 600.0, 0.05)


def test_turns_and_the_whole_recording_are_looked_at():
    rate = np.where((IMU_S > 300.0) & (IMU_S < 320.0), np.sin(IMU_S), 0.0)
    chosen = PINGS_S[choose_pings(PINGS_S, IMU_S, rate)]
    inside = (chosen > 300.0) & (chosen < 320.0)
    assert inside.sum() >= 15
    assert chosen[0] < 5.0
    assert chosen[-1] > 590.0
    assert len(chosen) <= 36 * 4


def test_more_bursts_are_taken_only_where_they_lie_apart():
    assert more_bursts(PINGS_S, 0.9) == 0
    assert more_bursts(PINGS_S[PINGS_S < 120.0], 0.3) == 0
    assert more_bursts(PINGS_S, 0.3) == 108
    assert more_bursts(PINGS_S[PINGS_S < 300.0], 0.3) == 74
    assert more_bursts(PINGS_S[:0], 0.3) == 0
    rate = np.sin(IMU_S)
    few, many = (choose_pings(PINGS_S, IMU_S, rate, n) for n in (36, 108))
    assert len(many) > 2.5 * len(few)


def test_pings_too_seldom_show_nothing():
    assert len(choose_pings(np.arange(0.0, 100.0, 2.5), IMU_S, np.sin(IMU_S))) == 0
