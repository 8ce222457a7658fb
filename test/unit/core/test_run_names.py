"""Runs of a vehicle are counted where people read of them."""

import dataclasses

from places import room_submap

from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.submap import SubmapId, Track

FIRST, SECOND, OTHER = Track("auv_1", 1936390121), Track("auv_1", 77), Track("auv_2", 5)


def names(*tracks):
    """Of runs that follow each other."""
    return RunNames(
        dataclasses.replace(room_submap(vehicle, sequence=number), run_id=run)
        for number, (vehicle, run) in enumerate(tracks)
    )


def test_runs_are_counted_by_their_times_and_not_by_their_numbers():
    shown = names(FIRST, OTHER, SECOND)
    assert [shown.track(t) for t in (FIRST, SECOND, OTHER)] == ["auv_1", "auv_1#2", "auv_2"]
    assert [shown.file(t) for t in (FIRST, SECOND, OTHER)] == ["auv_1", "auv_1_run2", "auv_2"]
    assert shown.submap(SubmapId(*SECOND, 3)) == "auv_1#2/3"
    assert [shown.number(t) for t in (FIRST, SECOND, OTHER)] == [1, 2, 1]


def test_a_vehicle_that_is_called_like_anothers_second_run_keeps_its_files():
    shown = names(FIRST, SECOND, Track("auv_1_run2", 9))
    assert shown.file(Track("auv_1_run2", 9)) == "auv_1_run2"
    assert shown.file(SECOND) == "auv_1_run2_"


def test_sentences_are_told_with_counted_runs():
    shown = names(FIRST, SECOND, OTHER)
    text = "leaps 5 m from auv_1#1936390121/2 to auv_1#77/0, beside auv_2#5/1 and auv_3#77/0, #77"
    expected = "leaps 5 m from auv_1/2 to auv_1#2/0, beside auv_2/1 and auv_3#77/0, #77"
    assert shown.in_text(text) == expected
    assert shown.in_text("set aside") == "set aside"


def test_runs_that_are_not_known_keep_their_number():
    assert RunNames(()).track(SECOND) == "auv_1#77"
    assert RunNames(()).track(Track("auv_1", 0)) == "auv_1"
