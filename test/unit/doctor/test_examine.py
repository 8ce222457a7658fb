"""Each wrong convention is named, with what mends it; nothing is said where nothing is wrong."""

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from unit.doctor.made_up_vehicle import vehicle

from uw_dslam_ros2.core.doctor import PingSample, examine
from uw_dslam_ros2.core.doctor.judging.imu import compare_yaw_and_rate

SEEDS = (1, 2)
vehicle = functools.cache(vehicle)


@pytest.fixture(scope="module")
def recording():
    return vehicle(SEEDS[0])


def turned(points, angle_rad):
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return points @ np.array([[cos, sin], [-sin, cos]])


def imu(change):
    def corrupt(navigation, pings):
        yaw, rate = change(navigation.imu_s, navigation.yaw_rad, navigation.yaw_rate_rad_s)
        return replace(navigation, yaw_rad=yaw, yaw_rate_rad_s=rate), pings

    return corrupt


def dvl(change):
    def corrupt(navigation, pings):
        velocity = change(navigation.velocity_s, navigation.velocity_m_s)
        return replace(navigation, velocity_m_s=velocity), pings

    return corrupt


def sonar(change, delay_s=0.0):
    def corrupt(navigation, pings):
        points = tuple(change(p) for p in pings.points)
        return navigation, PingSample(pings.stamp_s + delay_s, points, pings.T_base_sonar)

    return corrupt


def without_lock(t, v):
    return np.where(((t > 30.0) & (t < 50.0))[:, None], 0.0, v)


def near_steel(t, yaw, rate):
    bump = np.sin(math.pi * (np.clip(t, 30.0, 50.0) - 30.0) / 20.0)
    return yaw + math.radians(20.0) * bump, rate


def late(imu_s=0.0, velocity_s=0.0):
    def corrupt(navigation, pings):
        return replace(
            navigation,
            imu_s=navigation.imu_s + imu_s,
            velocity_s=navigation.velocity_s + velocity_s,
        ), pings

    return corrupt


def filtered(t, yaw, rate):
    return np.interp(t - 0.8, t, yaw), rate


# Cause, how a recording gets it, and what mends it.
CASES = {
    "imu_ned": (
        imu(lambda _, yaw, rate: (0.5 * math.pi - yaw, -rate)),
        {"imu_orientation": "ned", "imu_rates": "frd"},
    ),
    "imu_no_orientation": (
        imu(lambda _, yaw, rate: (0.0 * yaw, rate)), {"imu_orientation": "none"},
    ),
    "imu_no_rates": (imu(lambda _, yaw, rate: (yaw, 0.0 * rate)), {"imu_rates": "none"}),
    "imu_rates_frd": (imu(lambda _, yaw, rate: (yaw, -rate)), {"imu_rates": "frd"}),
    "imu_rates_in_degrees": (
        imu(lambda _, yaw, rate: (yaw, np.degrees(rate))), {"imu_rates_in_degrees": True},
    ),
    "heading_disturbed": (imu(near_steel), {"imu_orientation": "none"}),
    "imu_drift": (
        imu(lambda t, yaw, rate: (yaw + 0.004 * t, rate + 0.004)), {"imu_drift_rad_s": 0.004},
    ),
    "dvl_sign": (dvl(lambda _, v: -v), {"velocity_yaw_offset_rad": math.pi}),
    "dvl_turned": (dvl(lambda _, v: turned(v, -0.8)), {"velocity_yaw_offset_rad": 0.8}),
    "dvl_mirrored": (dvl(lambda _, v: v * [1.0, -1.0]), {"velocity_is_mirrored": True}),
    "dvl_unit": (dvl(lambda _, v: 1000.0 * v), {"velocity_scale": 0.001}),
    "dvl_scale": (dvl(lambda _, v: 1.05 * v), {"velocity_scale": 1.0 / 1.05}),
    "sound_speed": (sonar(lambda p: 1.05 * p), {"sonar_range_scale": 1.0 / 1.05}),
    "sonar_range_factor": (sonar(lambda p: 2.0 * p), {"sonar_range_scale": 0.5}),
    "dvl_constant": (dvl(lambda _, v: 0.0 * v), {"velocity_zero_is_invalid": True}),
    "dvl_zero_without_lock": (dvl(without_lock), {"velocity_zero_is_invalid": True}),
    "sonar_mirrored": (sonar(lambda p: p * [1.0, -1.0]), {"sonar_is_mirrored": True}),
    "sonar_turned": (sonar(lambda p: turned(p, 1.6)), {"sonar_yaw_offset_rad": -1.6}),
    "sonar_delay": (sonar(lambda p: p, 0.3), {"sonar_delay_s": 0.3}),
    "imu_delay": (late(imu_s=0.5), {"imu_delay_s": 0.5}),
    "velocity_delay": (late(velocity_s=0.6), {"velocity_delay_s": 0.6}),
    "heading_delay": (imu(filtered), {"imu_rates": "none", "imu_delay_s": 0.8}),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "seed"), list(zip(CASES, itertools.cycle(SEEDS), strict=False)))
def test_the_cause_is_named_and_mended(kind, seed):
    corrupt, mends = CASES[kind]
    found = examine(*corrupt(*vehicle(seed)), "auv_1")
    assert [finding.kind for finding in found.findings] == [kind]
    assert found.findings[0].vehicle_id == "auv_1"
    changes = found.conventions.changes()
    assert set(changes) == set(mends)
    for name, value in mends.items():
        # This vehicle's speed hardly changes, and so hardly shows when it did.
        tolerance = {
            "velocity_delay_s": 0.15,
            "sonar_range_scale": 0.015,
            "imu_drift_rad_s": 6e-4,
        }.get(name, 0.03)
        assert changes[name] == pytest.approx(value, abs=tolerance)


def test_echoes_in_feet_move_farther_than_any_vehicle_and_are_understood(recording):
    navigation, pings = sonar(lambda p: p / 0.3048)(*recording)
    found = examine(*imu(lambda _, yaw, rate: (0.5 * math.pi - yaw, -rate))(navigation, pings))
    assert [finding.kind for finding in found.findings] == ["imu_ned", "sonar_range_factor"]
    assert found.conventions.sonar_range_scale == pytest.approx(0.3048, abs=0.01)


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_said_where_nothing_is_wrong(seed):
    recording = vehicle(seed)
    found = examine(*recording)
    assert found.findings == []
    assert found.conventions.changes() == {}
    assert found.num_ping_motions > 40


@pytest.mark.parametrize("is_ned", [False, True])
def test_a_velocity_along_the_worlds_axes_is_turned_back(recording, is_ned):
    """As a filter's twist in its odom frame, sent as a DVL's; of north and east as well."""
    navigation, pings = recording
    yaw = np.interp(navigation.velocity_s, navigation.imu_s, navigation.yaw_rad)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = navigation.velocity_m_s.T
    in_world = np.column_stack([cos * x - sin * y, sin * x + cos * y])
    if is_ned:
        in_world = in_world[:, ::-1]
    found = examine(replace(navigation, velocity_m_s=in_world), pings)
    assert [f.kind for f in found.findings] == ["dvl_in_world"]
    changes = found.conventions.changes()
    assert changes.pop("velocity_axes") == "world"
    offset = 0.5 * math.pi if is_ned else 0.0
    assert changes.pop("velocity_yaw_offset_rad") == pytest.approx(offset, abs=0.05)
    assert changes == ({"velocity_is_mirrored": True} if is_ned else {})


def test_an_imu_and_a_velocity_in_north_and_east_are_both_told(recording):
    navigation, pings = recording
    yaw = np.interp(navigation.velocity_s, navigation.imu_s, navigation.yaw_rad)
    in_world = np.array([turned(v, a) for v, a in zip(navigation.velocity_m_s, yaw, strict=True)])
    navigation = replace(
        navigation,
        yaw_rad=0.5 * math.pi - navigation.yaw_rad,
        yaw_rate_rad_s=-navigation.yaw_rate_rad_s,
        velocity_m_s=in_world[:, ::-1],
    )
    found = examine(navigation, pings)
    assert [f.kind for f in found.findings] == ["imu_ned", "dvl_in_world"]
    changes = found.conventions.changes()
    assert changes.pop("velocity_yaw_offset_rad") == pytest.approx(0.5 * math.pi, abs=0.05)
    assert changes == {
        "imu_orientation": "ned",
        "imu_rates": "frd",
        "velocity_axes": "world",
        "velocity_is_mirrored": True,
    }


def test_a_velocity_against_water_that_moves_is_told(recording):
    navigation, pings = recording
    yaw = np.interp(navigation.velocity_s, navigation.imu_s, navigation.yaw_rad)
    current = np.array([turned(np.array([0.15, -0.1]), -a) for a in yaw])
    found = examine(replace(navigation, velocity_m_s=navigation.velocity_m_s + current), pings)
    assert [f.kind for f in found.findings] == ["dvl_in_water"]
    said = float(found.findings[0].detail.split()[2])
    assert said == pytest.approx(math.hypot(0.15, 0.1), abs=0.03)
    assert found.conventions.changes() == {}


def test_without_an_orientation_a_velocity_along_the_worlds_axes_is_only_told(recording):
    navigation, pings = recording
    yaw = np.interp(navigation.velocity_s, navigation.imu_s, navigation.yaw_rad)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = navigation.velocity_m_s.T
    in_world = np.column_stack([cos * x - sin * y, sin * x + cos * y])
    no_yaw = np.full_like(navigation.yaw_rad, np.nan)
    found = examine(replace(navigation, velocity_m_s=in_world, yaw_rad=no_yaw), pings)
    assert [f.kind for f in found.findings] == ["dvl_in_world"]
    assert found.conventions.changes() == {}


@pytest.mark.parametrize("turn_deg", [-25.0, 20.0])
def test_a_sonar_that_was_knocked_is_turned_from_then_on(turn_deg):
    navigation, pings = vehicle(3, 85.0)
    points = tuple(
        turned(p, -math.radians(turn_deg)) if t > 45.0 else p
        for t, p in zip(pings.stamp_s, pings.points, strict=True)
    )
    knocked = PingSample(pings.stamp_s, points, pings.T_base_sonar, start_s=1000.0)
    found = examine(navigation, knocked)
    assert [f.kind for f in found.findings] == ["sonar_knocked"]
    changes = found.conventions.changes()
    assert changes.pop("sonar_knocked_at_s") == pytest.approx(1045.0, abs=3.0)
    turn_rad = changes.pop("sonar_knocked_yaw_rad")
    assert math.degrees(turn_rad) == pytest.approx(turn_deg, abs=4.0)
    assert changes == {}


def test_a_dvl_that_was_knocked_is_no_fault_of_the_sonar():
    navigation, pings = vehicle(3, 85.0)
    velocity = navigation.velocity_m_s.copy()
    is_after = navigation.velocity_s > 45.0
    velocity[is_after] = turned(velocity[is_after], math.radians(-20.0))
    found = examine(replace(navigation, velocity_m_s=velocity), pings)
    assert [f.kind for f in found.findings] == ["dvl_knocked"]
    assert found.conventions.changes() == {}


@pytest.mark.parametrize("tilt_deg", [2.0, 15.0])
def test_short_echoes_of_a_tilted_sonar_are_no_fault_of_the_dvl(recording, tilt_deg):
    navigation, pings = recording
    short = PingSample(
        pings.stamp_s,
        tuple(0.95 * points for points in pings.points),
        pings.T_base_sonar,
        tilt_rad=math.radians(tilt_deg),
    )
    found = examine(navigation, short)
    (finding,) = found.findings
    assert finding.kind == ("sonar_tilt" if tilt_deg > 5.0 else "dvl_scale")
    if tilt_deg > 5.0:
        scale = found.conventions.changes()["sonar_range_scale"]
        assert scale == pytest.approx(1.0 / 0.95, abs=0.03)  # as of dvl_scale


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_wild_velocities_among_others_say_nothing_of_the_unit(recording, unit):
    navigation, pings = recording
    velocity = unit * navigation.velocity_m_s.copy()
    velocity[::20] = unit * np.array([50.0, 20.0])
    found = examine(replace(navigation, velocity_m_s=velocity), pings).conventions.changes()
    assert found == ({} if unit == 1.0 else {"velocity_scale": 0.001})


def test_a_bias_of_the_rates_counts_only_without_an_orientation(recording):
    navigation, pings = recording
    biased = replace(navigation, yaw_rate_rad_s=navigation.yaw_rate_rad_s + 0.004)
    assert examine(biased, pings).findings == []
    no_yaw = np.full(len(navigation.imu_s), math.nan)
    (finding,) = examine(replace(biased, yaw_rad=no_yaw), pings).findings
    assert finding.kind == "imu_drift"


def test_without_a_dvl_the_imu_and_the_sonar_are_late_alike(recording):
    navigation, pings = late(imu_s=0.5)(*recording)
    alone = replace(
        navigation, velocity_s=navigation.velocity_s[:0], velocity_m_s=navigation.velocity_m_s[:0]
    )
    (finding,) = examine(alone, pings).findings
    assert finding.kind == "sonar_delay"
    assert "or it is the imu" in finding.detail
    assert finding.confidence == 0.5


def test_a_late_imu_with_a_later_heading_is_mended_by_both(recording):
    found = examine(*late(imu_s=0.5)(*imu(filtered)(*recording)))
    assert [finding.kind for finding in found.findings] == ["heading_delay", "imu_delay"]
    assert found.conventions.imu_rates == "none"
    assert found.conventions.imu_delay_s == pytest.approx(1.3, abs=0.05)


def test_pixels_of_power_are_told_unless_they_are_read_so(recording):
    navigation, pings = recording
    found = examine(navigation, replace(pings, pixels="power"))
    assert [finding.kind for finding in found.findings] == ["sonar_power"]
    assert found.sonar_changes == {"intensity": "power"}
    known = replace(pings, pixels="power", pixels_read_as="power")
    assert examine(navigation, known).findings == []


def test_pixels_of_decibels_are_told_with_their_step(recording):
    navigation, pings = recording
    found = examine(navigation, replace(pings, pixels="decibel", db_per_count=0.3789))
    assert [finding.kind for finding in found.findings] == ["sonar_decibel"]
    assert found.sonar_changes == {"intensity": "decibel", "db_per_count": 0.38}


def test_beams_that_never_hold_anything_are_told_with_their_side(recording):
    navigation, pings = recording
    dead = replace(pings, silent_share=0.5, silent_rad=tuple(np.linspace(-1.0, 0.0, 64)))
    (finding,) = examine(navigation, dead).findings
    assert (finding.kind, finding.role) == ("sonar_silent_beams", "sonar")
    assert "50 % of its beams, between 57 degrees to starboard" in finding.detail
    few = replace(pings, silent_share=0.02, silent_rad=(0.1,))
    assert examine(navigation, few).findings == []


@pytest.mark.parametrize("rate", [0.004, -0.01])
def test_a_steady_drift_is_mended_where_heading_and_rates_have_it(recording, rate):
    both = imu(lambda t, yaw, r: (yaw + rate * t, r + rate))(*recording)
    alone = imu(lambda _, yaw, r: (np.full_like(yaw, np.nan), r + rate))(*recording)
    for navigation, pings in (both, alone):
        found = examine(navigation, pings)
        assert [finding.kind for finding in found.findings] == ["imu_drift"]
        assert found.conventions.imu_drift_rad_s == pytest.approx(rate, abs=6e-4)
    # Beside a heading that holds, rates with a bias are the filter's task.
    held = imu(lambda _, yaw, r: (yaw, r + rate))(*recording)
    assert examine(*held).findings == []


@pytest.mark.parametrize(
    ("corrupt", "sign"),
    [
        (sonar(lambda p: p * [1.0, -1.0]), 1.0),
        (imu(lambda _, yaw, rate: (0.5 * math.pi - yaw, -rate)), -1.0),
    ],
)
def test_a_drift_is_mended_as_the_heading_is_read(recording, corrupt, sign):
    drifts = imu(lambda t, yaw, rate: (yaw + 0.004 * t, rate + 0.004))
    found = examine(*drifts(*corrupt(*recording)))
    assert found.conventions.imu_drift_rad_s == pytest.approx(sign * 0.004, abs=6e-4)


def test_a_drift_that_comes_and_goes_is_told_and_not_mended(recording):
    def late(t, yaw, rate):
        return yaw + 0.02 * np.maximum(t - 30.0, 0.0), rate + 0.02 * (t > 30.0)

    found = examine(*imu(late)(*recording))
    assert [finding.kind for finding in found.findings] in (["imu_drift"], [])
    assert found.conventions.changes() == {}


def test_without_echoes_only_what_needs_none_is_said(recording):
    navigation, pings = recording
    nothing = PingSample(pings.stamp_s, (np.empty((0, 2)),) * len(pings.stamp_s))
    reversed_sign = replace(navigation, velocity_m_s=-navigation.velocity_m_s)
    assert examine(reversed_sign, nothing).findings == []
    zeros = dvl(without_lock)(navigation, nothing)
    assert [f.kind for f in examine(*zeros).findings] == ["dvl_zero_without_lock"]


def test_it_cannot_tell_who_is_mirrored_without_a_dvl(recording):
    navigation, pings = sonar(lambda p: p * [1.0, -1.0])(*recording)
    alone = replace(
        navigation, velocity_s=navigation.velocity_s[:0], velocity_m_s=navigation.velocity_m_s[:0]
    )
    found = examine(alone, pings)
    assert [finding.kind for finding in found.findings] == ["handedness"]
    assert found.conventions.changes() == {}


def test_stops_of_commanded_velocities_are_no_lost_lock():
    navigation, pings = vehicle(1)
    levels = np.round(navigation.velocity_m_s * (3.0, 0.0)) / 3.0
    stops = ((navigation.velocity_s > 30.0) & (navigation.velocity_s < 50.0))[:, None]
    commanded = replace(navigation, velocity_m_s=np.where(stops, 0.0, levels))
    nothing = PingSample(pings.stamp_s[:0], ())
    assert examine(commanded, nothing).findings == []
    measured = replace(navigation, velocity_m_s=np.where(stops, 0.0, navigation.velocity_m_s))
    assert [f.kind for f in examine(measured, nothing).findings] == ["dvl_zero_without_lock"]


@pytest.mark.parametrize("largest_rad", [0.35, 0.4, 0.45, 0.49, 0.51])
def test_a_heading_in_time_is_not_late_however_little_it_turns(largest_rad):
    t = np.arange(0.0, 45.0, 0.04)
    yaw = 0.3 * np.sin(0.2 * t) + np.where(t > 40.0, 0.06 * (t - 40.0) ** 2, 0.0)
    first, last = slice(50, 1037), slice(88, 1075)  # spans of 1.5 s that a delay of 2 s leaves
    yaw *= largest_rad / np.ptp(yaw[last] - yaw[first])
    noise = np.random.default_rng(1).normal(0.0, 0.005, (2, len(t)))
    rate = np.gradient(yaw, t)
    state = compare_yaw_and_rate(t, yaw + noise[0], rate + noise[1])
    assert state.orientation_delay_s == 0.0


def test_a_gap_of_the_imu_is_no_swing_of_its_heading():
    navigation, pings = vehicle(1)
    keep = (navigation.imu_s < 30.0) | (navigation.imu_s > 55.0)
    gap = replace(
        navigation,
        imu_s=navigation.imu_s[keep],
        yaw_rad=navigation.yaw_rad[keep],
        yaw_rate_rad_s=navigation.yaw_rate_rad_s[keep],
    )
    assert examine(gap, PingSample(pings.stamp_s[:0], ())).findings == []
    silent = replace(navigation, yaw_rad=np.where(keep, navigation.yaw_rad, np.nan))
    assert examine(silent, PingSample(pings.stamp_s[:0], ())).findings == []
