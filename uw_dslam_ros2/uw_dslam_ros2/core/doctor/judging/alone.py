"""What navigation says against itself, without any echo."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.judging.imu import ImuState
from uw_dslam_ros2.core.doctor.motions.delays import late_in_words
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample

__all__ = ["judge_imu", "without_spikes", "without_zeros"]

_SWING_RAD = math.radians(8.6)
_ZEROS_IN_A_ROW = 3
_MOVES_M_S = 0.15
_MIN_VELOCITIES = 20
_SPIKE = 3.0
_LEAST_DISTINCT = 0.05  # of measured velocities; of commanded ones a few in a thousand are


def judge_imu(result: Examination, imu: ImuState) -> None:
    """Tell what the orientation and the rates of an IMU say of each other."""
    if imu.is_orientation_constant:
        assert imu.by_rates is not None
        turned = math.degrees(float(np.ptp(imu.by_rates)))
        result.tell(
            "imu_no_orientation",
            "imu",
            f"its orientation never changes while its rates turn by {turned:.0f} degrees: the "
            "driver does not fill it, or not in the order x, y, z, w; use only the rates "
            "(conventions.imu_orientation: none)",
            imu_orientation="none",
        )
    if imu.are_rates_zero:
        result.tell(
            "imu_no_rates",
            "imu",
            "its rates are all zero while its orientation turns: the driver does not fill "
            "them; use only the orientation (conventions.imu_rates: none)",
            imu_rates="none",
        )
    if 40.0 < abs(imu.ratio) < 80.0:
        result.tell(
            "imu_rates_in_degrees",
            "imu",
            f"its rates are {abs(imu.ratio):.1f} times too fast for its orientation: they are "
            "in degrees per second (conventions.imu_rates_in_degrees: true)",
            imu_rates_in_degrees=True,
        )
    if imu.orientation_delay_s:
        late_s = imu.orientation_delay_s
        result.tell(
            "heading_delay",
            "imu",
            f"its orientation turns {late_in_words(late_s)} than its own rates, as behind a slow "
            "filter; use only the orientation, at its own time (conventions.imu_rates: none"
            + (f", conventions.imu_delay_s: {late_s:.2f})" if late_s > 0.0 else ")"),
            imu_rates="none",
            imu_delay_s=round(max(0.0, late_s), 3),
        )
    if imu.swing_rad > _SWING_RAD:
        result.tell(
            "heading_disturbed",
            "imu",
            f"its heading swings by {math.degrees(imu.swing_rad):.0f} degrees against its "
            "rates, as near steel; calibrate the compass, or use only the rates "
            "(conventions.imu_orientation: none)",
            imu_orientation="none",
        )


def without_zeros(result: Examination, navigation: NavigationSample) -> NavigationSample:
    """Tell of runs of exact zeros between velocities that are far from zero, and drop them.

    Velocities that were commanded, not measured, repeat a few values: their zeros are stops.
    """
    velocity = navigation.velocity_m_s
    if len(velocity) >= _MIN_VELOCITIES and not np.ptp(velocity, axis=0).any():
        return _without_constant(result, navigation)
    is_zero = ~velocity.any(axis=1)
    moving = velocity[~is_zero]
    if len(np.unique(moving, axis=0)) < _LEAST_DISTINCT * len(moving):
        return navigation
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_zero, [False]]).astype(int)))
    num_false, longest_s = 0, 0.0
    for begin, end in edges.reshape(-1, 2):
        around = [velocity[i] for i in (begin - 1, end) if 0 <= i < len(velocity)]
        speeds = [float(np.hypot(*v)) for v in around]
        if end - begin >= _ZEROS_IN_A_ROW and speeds and max(speeds) > _MOVES_M_S:
            num_false += int(end - begin)
            last = min(end, len(velocity) - 1)
            seconds = float(navigation.velocity_s[last] - navigation.velocity_s[begin])
            longest_s = max(longest_s, seconds)
    if num_false == 0:
        return navigation
    result.tell(
        "dvl_zero_without_lock",
        "velocity",
        f"{num_false} velocities are exactly zero, up to {longest_s:.0f} s on end, while the "
        "vehicle moves before and after: the dvl had no bottom lock "
        "(conventions.velocity_zero_is_invalid: true)",
        velocity_zero_is_invalid=True,
    )
    return replace(
        navigation, velocity_s=navigation.velocity_s[~is_zero], velocity_m_s=velocity[~is_zero]
    )


def without_spikes(navigation: NavigationSample) -> NavigationSample:
    """Drop velocities that are far from all others: the mapper's filter refuses them as well."""
    speed = np.hypot(*navigation.velocity_m_s.T)
    if len(speed) < _MIN_VELOCITIES:
        return navigation
    is_spike = speed > _SPIKE * np.quantile(speed, 0.9)
    return replace(
        navigation,
        velocity_s=navigation.velocity_s[~is_spike],
        velocity_m_s=navigation.velocity_m_s[~is_spike],
    )


def _without_constant(result: Examination, navigation: NavigationSample) -> NavigationSample:
    """Tell of velocities that are all the same, and drop them: nothing is measured so."""
    forward, left = (float(v) for v in navigation.velocity_m_s[0])
    is_zero = not navigation.velocity_m_s.any()
    mend = " (conventions.velocity_zero_is_invalid: true)" if is_zero else ""
    result.tell(
        "dvl_constant",
        "velocity",
        f"all its {len(navigation.velocity_m_s)} velocities are ({forward:.2f}, {left:.2f}) "
        f"m/s to the last digit: its driver does not fill them, or the dvl is off{mend}",
        **({"velocity_zero_is_invalid": True} if is_zero else {}),
    )
    none = navigation.velocity_s[:0], navigation.velocity_m_s[:0]
    return replace(navigation, velocity_s=none[0], velocity_m_s=none[1])
