"""Bursts show the turns and the whole recording; more pings are taken where some tell."""

from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.doctor.motions.fits import TurnFit, confidence_of
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.doctor.samples.bursts import choose_pings, more_pings

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


def looked_at(pings_s):
    return pings_s[choose_pings(pings_s, IMU_S, np.sin(IMU_S))]


def test_more_pings_are_taken_where_those_nearby_have_echoes():
    seen = looked_at(PINGS_S)
    further = PINGS_S[more_pings(PINGS_S, seen, seen > 450.0)]
    assert len(further) > 1.5 * len(seen)
    assert further.min() > 430.0
    assert not np.isin(further, seen).any()
    assert np.histogram(further, 5, (450.0, 600.0))[0].min() > 30
    anywhere = more_pings(PINGS_S, seen, np.arange(len(seen)) % 2 == 0)
    assert len(anywhere) + len(seen) <= 432


def test_a_short_recording_shows_more_between_the_pings_seen():
    short = PINGS_S[PINGS_S < 150.0]
    seen = looked_at(short)
    further = short[more_pings(short, seen, (seen > 60.0) & (seen < 100.0))]
    assert len(further) > 60
    assert np.diff(further).min() >= 0.25
    assert 55.0 < further.min() < further.max() < 105.0


def test_no_more_pings_are_taken_where_most_tell_or_none_does():
    seen = looked_at(PINGS_S)
    assert len(more_pings(PINGS_S, seen, np.arange(len(seen)) % 10 > 1)) == 0
    assert len(more_pings(PINGS_S, seen, np.zeros(len(seen), bool))) == 0
    assert len(more_pings(PINGS_S[:0], PINGS_S[:0], np.zeros(0, bool))) == 0
    assert len(more_pings(PINGS_S, PINGS_S[:1], np.ones(1, bool))) == 0


def test_pings_too_seldom_show_nothing():
    assert len(choose_pings(np.arange(0.0, 100.0, 2.5), IMU_S, np.sin(IMU_S))) == 0


def test_motions_of_the_same_moment_count_once():
    def motions(begin_s):
        begin = np.array(begin_s)
        return PingMotions(begin, begin + 1.0, np.zeros((len(begin), 3)), np.empty((0, 3, 3)))

    assert motions([0.0, 1.0, 2.0, 9.0]).repeats == 1.0
    assert motions([0.0, 0.5, 1.0, 1.5, 2.0]).repeats == pytest.approx(5.0 / 3.0)
    assert motions([]).repeats == 1.0


def test_what_is_seen_twice_is_not_twice_as_sure():
    cost = np.array([0.1, 0.2, 0.1, 0.3])
    once = TurnFit(1, 0.0, cost), TurnFit(-1, 0.0, cost + 1.0)
    thrice = [replace(fit, cost=np.repeat(fit.cost, 3), repeats=3.0) for fit in once]
    assert confidence_of(*thrice) == pytest.approx(confidence_of(*once))
    assert confidence_of(*reversed(once)) < 0.5 < confidence_of(*once)


def test_the_best_of_many_needs_a_larger_lead():
    better, worse = (TurnFit(1, 0.0, np.full(9, cost)) for cost in (1.0, 1.5))

    def odds(num_tried):
        sure = confidence_of(better, worse, num_tried)
        return sure / (1.0 - sure)

    assert odds(4) == pytest.approx(odds(1) / 4.0)
