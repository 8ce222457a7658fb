"""What the beams of a sonar that turns say of the recording's conventions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination, words_of
from uw_dslam_ros2.core.doctor.judging.imu import ImuState, compare_yaw_and_rate
from uw_dslam_ros2.core.doctor.judging.odometry import OdometrySample, say_mirrored
from uw_dslam_ros2.core.doctor.motions.delays import late_in_words
from uw_dslam_ros2.core.doctor.motions.fits import SURE
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample
from uw_dslam_ros2.core.doctor.turning.turns import (
    MAX_DELAY_S,
    BeamSample,
    TurningFit,
    TurningTrial,
    choose_windows,
)

__all__ = ["choose_spans", "examine_turning", "examine_turning_by_odometry"]

FloatArray = NDArray[np.float64]

_SHARED = 1.5
"""Windows overlap by half, so that so many of them count as one."""
_MIN_OFFSET_RAD, _SIGMAS = math.radians(4.0), 4.0
_MIN_DELAY_S = 0.15
_AT_END_S = 0.05  # of the longest delay that is tried: it may be longer


def examine_turning(
    result: Examination,
    navigation: NavigationSample,
    beams: BeamSample,
    spans: Sequence[tuple[float, float]],
) -> None:
    """Add to an examination what the beams (N,) say: direction, zero, and the heading's delay.

    Nothing is added where too few turns can be compared, or no reading of them is clearly best.
    """
    imu = compare_yaw_and_rate(navigation.imu_s, navigation.yaw_rad, navigation.yaw_rate_rad_s)
    yaw = _yaw_of(result, imu)
    if yaw is None:
        return
    if result.conventions.velocity_zero_is_invalid:
        is_said = navigation.velocity_m_s.any(axis=1)
        navigation = replace(
            navigation,
            velocity_s=navigation.velocity_s[is_said],
            velocity_m_s=navigation.velocity_m_s[is_said],
        )
    trial = TurningTrial(beams, navigation, yaw, spans)
    result.num_turning_windows = trial.num_windows
    if trial.num_windows:
        _Judge(result, trial, navigation, imu).run()


def examine_turning_by_odometry(
    result: Examination,
    odometry: OdometrySample,
    beams: BeamSample,
    spans: Sequence[tuple[float, float]],
) -> None:
    """Add whether turns run against the poses of a filter that is all the navigation there is."""
    navigation = odometry.as_navigation()
    trial = TurningTrial(beams, navigation, np.unwrap(odometry.yaw_rad), spans)
    result.num_turning_windows = trial.num_windows
    if not trial.num_windows or result.conventions.odometry == "ned":
        return
    sure = confidence_of(trial.best(-1), trial.best(1))
    if sure > SURE:
        say_mirrored(result, odometry, sure)


def choose_spans(navigation: NavigationSample, ping_s: FloatArray) -> list[tuple[float, float]]:
    """Parts [s] of a recording with pings (P,) that show most."""
    imu = compare_yaw_and_rate(navigation.imu_s, navigation.yaw_rad, navigation.yaw_rate_rad_s)
    yaw = imu.by_rates if imu.by_orientation is None else imu.by_orientation
    if yaw is None or len(ping_s) == 0:
        return []
    return choose_windows(float(ping_s[0]), float(ping_s[-1]), navigation.imu_s, yaw)


def _yaw_of(result: Examination, imu: ImuState) -> FloatArray | None:
    """Yaw (K,) by orientation, which does not drift, or by rates where it says nothing."""
    if imu.by_orientation is not None and result.conventions.imu_orientation != "none":
        return imu.by_orientation
    if imu.by_rates is None:
        return None
    return imu.by_rates * (math.pi / 180.0 if result.conventions.imu_rates_in_degrees else 1.0)


def confidence_of(better: TurningFit, worse: TurningFit) -> float:
    """How sure it is that the better one's lead over windows is no chance, 0 to 1."""
    lead = better.score - worse.score
    count = len(lead) / _SHARED
    if count < 2.0:
        return 0.5
    sigma = float(np.std(lead, ddof=1)) / math.sqrt(count)
    return _probability(float(lead.mean()) / max(sigma, 1e-9))


def _probability(deviations: float) -> float:
    return 0.5 + 0.5 * math.erf(deviations / math.sqrt(2.0))


class _Judge:
    def __init__(
        self,
        result: Examination,
        trial: TurningTrial,
        navigation: NavigationSample,
        imu: ImuState,
    ) -> None:
        self._result, self._trial, self._imu = result, trial, imu
        self._velocity_m_s = navigation.velocity_m_s

    def run(self) -> None:
        usual, other_way = self._trial.best(1), self._trial.best(-1)
        starts = (
            replace(other_way.reading, side=1, heading=-1, offset_rad=offset)
            for offset in (0.0, -other_way.reading.offset_rad)
        )
        by_heading = max((self._trial.refined(start) for start in starts), key=lambda f: f.mean)
        # What is usual stays until it is clearly wrong.
        best = usual
        sure = min(confidence_of(by_heading, usual), confidence_of(by_heading, other_way))
        if sure > SURE:
            best = by_heading
            self._say_heading(sure)
        else:
            if (sure := confidence_of(other_way, usual)) > SURE:
                best = other_way
                self._say_other_way(sure, is_in_doubt=confidence_of(best, by_heading) < SURE)
            if self._are_opposed and confidence_of(best, by_heading) > SURE:
                self._say_rates(confidence_of(best, by_heading))
        self._judge_offset(best)
        self._judge_delay(best)

    @property
    def _is_by_orientation(self) -> bool:
        is_said = self._imu.by_orientation is not None
        return is_said and self._result.conventions.imu_orientation != "none"

    @property
    def _are_opposed(self) -> bool:
        """Whether the rates turn against the orientation that the turns were tried with."""
        return self._is_by_orientation and self._imu.ratio < 0.0

    def _say_heading(self, sure: float) -> None:
        changes = {}
        if self._is_by_orientation:
            changes["imu_orientation"] = "ned"
        if self._imu.by_rates is not None and not self._are_opposed:
            changes["imu_rates"] = "frd"
        self._result.tell(
            "imu_ned",
            "imu",
            "it turns against the sonar's turns, which agree with one another and with the "
            f"sideways velocity if its yaw grows clockwise ({words_of(changes)})",
            sure,
            **changes,
        )

    def _say_rates(self, sure: float) -> None:
        self._result.tell(
            "imu_rates_frd",
            "imu",
            "its rates turn against its own yaw, with which the sonar's turns agree: their z "
            "axis points down (conventions.imu_rates: frd)",
            sure,
            imu_rates="frd",
        )

    def _say_other_way(self, sure: float, *, is_in_doubt: bool) -> None:
        self._result.tell(
            "sonar_mirrored",
            "sonar",
            "its turns meet one another only if they run the other way: its angles grow clockwise "
            "(conventions.sonar_is_mirrored: true)"
            + (
                "; an imu that speaks ned would look alike here, so make sure that the map is not "
                "a mirror image"
                if is_in_doubt
                else ""
            ),
            sure,
            sonar_is_mirrored=True,
        )

    def _judge_offset(self, best: TurningFit) -> None:
        offset = math.remainder(best.reading.offset_rad, 2.0 * math.pi)
        sigma = self._trial.offset_sigma_rad(best)
        if abs(offset) < max(_MIN_OFFSET_RAD, _SIGMAS * sigma):
            return
        usual = self._trial.score(replace(best.reading, offset_rad=0.0))
        sure = confidence_of(best, usual)
        if sure < SURE:
            return
        degrees = math.degrees(offset)
        mean = complex(*np.median(self._velocity_m_s, axis=0))
        # A vehicle goes ahead more often than not: who says so is right.
        by_velocity = abs(np.angle(mean)) + 0.05
        by_echoes = abs(np.angle(mean * np.exp(-1j * offset)))
        if by_echoes > by_velocity:
            self._result.tell(
                "sonar_turned",
                "sonar",
                f"its turns meet one another only if its zero is {degrees:.0f} degrees from where "
                "tf says, counter-clockwise (conventions.sonar_yaw_offset_rad: "
                f"{offset:.3f})",
                sure,
                sonar_yaw_offset_rad=round(offset, 4),
            )
        elif abs(abs(degrees) - 180.0) < 15.0:
            self._result.tell(
                "dvl_sign",
                "velocity",
                "its velocity has the wrong sign: it is the bottom's against the vehicle "
                "(conventions.velocity_yaw_offset_rad: 3.1416)",
                sure,
                velocity_yaw_offset_rad=round(math.pi, 4),
            )
        else:
            self._result.tell(
                "dvl_turned",
                "velocity",
                f"its velocity is {degrees:.0f} degrees off the sonar's motion: it is mounted "
                f"turned (conventions.velocity_yaw_offset_rad: {-offset:.3f})",
                sure,
                velocity_yaw_offset_rad=round(-offset, 4),
            )

    def _judge_delay(self, best: TurningFit) -> None:
        delay_s = best.reading.delay_s
        # What the imu says against itself may have shown the same delay already.
        known_s = self._result.conventions.imu_delay_s
        still = self._trial.score(replace(best.reading, delay_s=known_s))
        sure = confidence_of(best, still)
        if abs(delay_s - known_s) < _MIN_DELAY_S or sure < SURE:
            return
        if abs(delay_s) > MAX_DELAY_S - _AT_END_S:
            self._result.tell(
                "imu_delay",
                "imu",
                f"its stamps are {'later' if delay_s > 0.0 else 'earlier'} than the sonar's by "
                f"{MAX_DELAY_S:.0f} s or more: where a message holds a turn, its stamp may be "
                "that of the last beam (scan_stamp: last), or its beams' times are not told "
                "(scan_period_s)",
                sure,
            )
            return
        self._result.tell(
            "imu_delay",
            "imu",
            f"its stamps are {late_in_words(delay_s)} than the sonar's, by where the walls lie "
            f"while the vehicle turns (conventions.imu_delay_s: {delay_s:.2f})",
            sure,
            imu_delay_s=round(delay_s, 3),
        )
