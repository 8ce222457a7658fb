"""Clocks that are zero, jump or disagree, on made-up streams."""

import numpy as np
import pytest

from uw_dslam_ros2.core.clocks import StreamTimes, corrected_clocks, find_gaps, gaps_at_the_ends

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def times(rate_hz, seconds=120.0, delay_s=0.05, seed=0):
    """True times and times of recording [ns], with a delay that varies a little."""
    true = START + (np.arange(int(seconds * rate_hz)) / rate_hz * SECOND).astype(np.int64)
    jitter = np.random.default_rng(seed).uniform(0.0, 0.02, len(true))
    return true, true + ((delay_s + jitter) * SECOND).astype(np.int64)


def vehicle(**stamps_of):
    """Streams with true stamps, or what a function makes of them, and the truth."""
    streams, truth = {}, {}
    for seed, (role, rate_hz) in enumerate((("sonar", 3.0), ("imu", 25.0), ("velocity", 6.0))):
        true, recorded = times(rate_hz, seed=seed)
        streams[role] = StreamTimes(stamps_of.get(role, lambda t: t)(true.copy()), recorded)
        truth[role] = true
    return streams, truth


def worst_s(stamps, truth):
    return max(float(np.abs(stamps[role] - truth[role]).max()) * 1e-9 for role in truth)


def test_good_clocks_are_left_alone():
    streams, truth = vehicle()
    stamps, findings = corrected_clocks(streams)
    assert worst_s(stamps, truth) == 0.0
    assert findings == []


def test_a_vehicle_whose_whole_clock_is_wrong_is_right_in_itself():
    wrong = {role: lambda t: t - 3600 * SECOND for role in ("sonar", "imu", "velocity")}
    streams, _ = vehicle(**wrong)
    stamps, findings = corrected_clocks(streams)
    assert findings == []
    assert all((stamps[role] == streams[role].stamp_ns).all() for role in streams)


@pytest.mark.parametrize("hours", [-24.0, -1.0, 1.0])
def test_one_sensor_with_another_clock_is_brought_to_the_others(hours):
    streams, truth = vehicle(sonar=lambda t: t + int(hours * 3600) * SECOND)
    stamps, (finding,) = corrected_clocks(streams)
    assert worst_s(stamps, truth) < 0.05
    assert (finding.kind, finding.role) == ("clock_offset", "sonar")
    assert ("ahead of" if hours > 0 else "behind") in finding.detail


def test_a_sensor_that_is_only_slow_is_left_alone():
    streams, truth = vehicle()
    sonar = StreamTimes(streams["sonar"].stamp_ns, streams["sonar"].recorded_ns + 3 * SECOND)
    stamps, findings = corrected_clocks({**streams, "sonar": sonar})
    assert (stamps["sonar"] == truth["sonar"]).all()
    assert findings == []


@pytest.mark.parametrize("jump_s", [-40.0, -2.0, 2.0, 3600.0])
def test_a_clock_that_is_set_in_mid_mission_is_set_back(jump_s):
    def jumped(stamps):
        return stamps + np.where(stamps > START + 60 * SECOND, int(jump_s), 0) * SECOND

    streams, truth = vehicle(sonar=jumped, imu=jumped, velocity=jumped)
    stamps, (finding,) = corrected_clocks(streams)
    assert worst_s(stamps, truth) < 0.05
    assert (finding.kind, finding.role) == ("clock_jump", "")
    assert f"{abs(jump_s):.1f} s" in finding.detail
    # All sensors by the same: what lies between them stays as it was.
    late = truth["imu"] > START + 61 * SECOND
    moved = {int(d) for d in np.unique((stamps["imu"] - streams["imu"].stamp_ns)[late])}
    assert len(moved) == 1


def test_messages_that_are_held_up_are_no_jump():
    streams, truth = vehicle()
    for held_s in (0.5, 3.0):
        recorded = streams["imu"].recorded_ns.copy()
        until = recorded[1000] + int(held_s * SECOND)
        recorded[1000:] = np.maximum(recorded[1000:], until)  # then all at once
        held = StreamTimes(streams["imu"].stamp_ns, recorded)
        stamps, findings = corrected_clocks({**streams, "imu": held})
        assert findings == []
        assert worst_s(stamps, truth) == 0.0


def test_of_messages_that_come_irregularly_only_a_far_jump_is_believed():
    streams, _ = vehicle()
    rng = np.random.default_rng(5)
    lag = rng.uniform(0.0, 3.0, len(streams["sonar"].recorded_ns))
    recorded = np.sort(streams["sonar"].recorded_ns + (lag * SECOND).astype(np.int64))
    sonar = StreamTimes(streams["sonar"].stamp_ns, recorded)
    assert corrected_clocks({**streams, "sonar": sonar})[1] == []


def test_one_late_message_is_no_jump():
    def with_a_late_one(stamps):
        stamps[500] -= 5 * SECOND
        return stamps

    streams, truth = vehicle(imu=with_a_late_one)
    stamps, findings = corrected_clocks(streams)
    assert findings == []
    assert (np.delete(stamps["imu"], 500) == np.delete(truth["imu"], 500)).all()


def test_a_sensor_without_stamps_gets_the_times_of_recording():
    streams, truth = vehicle(sonar=np.zeros_like)
    stamps, (finding,) = corrected_clocks(streams)
    assert worst_s(stamps, truth) < 0.05
    assert (finding.kind, finding.role) == ("zero_stamps", "sonar")


def test_the_first_stamps_may_be_zero():
    def zero_at_first(stamps):
        stamps[:8] = 0
        return stamps

    streams, truth = vehicle(sonar=zero_at_first)
    stamps, findings = corrected_clocks(streams)
    assert findings == []
    assert (stamps["sonar"][:8] == 0).all()
    assert (stamps["sonar"][8:] == truth["sonar"][8:]).all()


def test_times_of_a_converter_say_nothing_of_clocks():
    """All is written within seconds, and the mission has a pause."""
    streams, truth = vehicle()
    for role in streams:
        is_kept = (truth[role] < START + 40 * SECOND) | (truth[role] > START + 70 * SECOND)
        stamp_ns = truth[role][is_kept]
        written_ns = START + 10**6 * np.arange(len(stamp_ns), dtype=np.int64)
        streams[role] = StreamTimes(stamp_ns, written_ns)
    stamps, findings = corrected_clocks(streams)
    assert findings == []
    assert all((stamps[role] == streams[role].stamp_ns).all() for role in streams)


def test_gaps_are_found_inside_and_at_the_ends():
    _, truth = vehicle()
    seconds = (truth["imu"] - START) // SECOND
    assert find_gaps(truth) == []
    silent = truth | {"imu": truth["imu"][(seconds < 40) | (seconds >= 70)]}
    (gap,) = find_gaps(silent)
    assert (gap.role, round(gap.seconds)) == ("imu", 30)
    (gap,) = find_gaps(truth | {"velocity": truth["velocity"][:-120]})
    assert (gap.role, round(gap.seconds)) == ("velocity", 20)


def test_a_dvl_without_lock_is_told_of_at_the_ends_alone():
    sonar_ns = np.arange(0, 240) * 500_000_000
    said = (sonar_ns >= 30e9) & ((sonar_ns < 60e9) | (sonar_ns > 80e9)) & (sonar_ns < 100e9)
    found = gaps_at_the_ends(sonar_ns, "velocity", sonar_ns[said])
    assert [(g.role, round(g.seconds)) for g in found] == [("velocity", 30), ("velocity", 20)]
    assert gaps_at_the_ends(sonar_ns, "velocity", sonar_ns) == []
    assert gaps_at_the_ends(sonar_ns, "velocity", sonar_ns[:0]) == []


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("same_stamps", lambda t: np.full_like(t, t[0])),
        ("whole_seconds", lambda t: t // SECOND * SECOND),
    ],
)
@pytest.mark.parametrize("role", ["sonar", "imu", "velocity"])
def test_stamps_that_tell_no_time_are_replaced_by_those_of_recording(kind, change, role):
    streams, truth = vehicle(**{role: change})
    stamps, findings = corrected_clocks(streams)
    assert [(f.kind, f.role) for f in findings] == [(kind, role)]
    assert worst_s(stamps, truth) < 0.05


@pytest.mark.parametrize("unit_ns", [1000, 1_000_000])
def test_fractions_in_microseconds_or_milliseconds_are_read_as_such(unit_ns):
    def change(t):
        return t // SECOND * SECOND + t % SECOND // unit_ns

    streams, truth = vehicle(imu=change)
    stamps, findings = corrected_clocks(streams)
    assert [(f.kind, f.role) for f in findings] == [("stamp_unit", "imu")]
    assert worst_s(stamps, truth) < 0.0011
    slow = {"imu": StreamTimes(*times(1.0))}  # one message a second, on the second
    assert corrected_clocks(slow)[1] == []
