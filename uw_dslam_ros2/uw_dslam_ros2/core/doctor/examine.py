"""Which conventions a recording follows: each is tried, and the one that fits best is named.

The sonar's own motion from ping to ping is the judge: it turns as the IMU says, and moves as the
DVL says, if all are read rightly. Of two readings that fit equally well neither is named.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.judging.alone import judge_imu, without_spikes, without_zeros
from uw_dslam_ros2.core.doctor.judging.images import judge_images
from uw_dslam_ros2.core.doctor.judging.imu import ImuState, compare_yaw_and_rate
from uw_dslam_ros2.core.doctor.judging.knocks import judge_knock
from uw_dslam_ros2.core.doctor.judging.odometry import OdometrySample, examine_odometry
from uw_dslam_ros2.core.doctor.judging.scales import judge_scale
from uw_dslam_ros2.core.doctor.judging.turn_errors import (
    is_scale_of_turns_wrong,
    judge_drift,
    judge_scale_of_turns,
)
from uw_dslam_ros2.core.doctor.judging.turns_and_times import say_delays, say_one_flipped
from uw_dslam_ros2.core.doctor.judging.velocities import (
    judge_current,
    judge_offset,
    say_in_world,
    say_mirrored,
)
from uw_dslam_ros2.core.doctor.motions.delays import find_delays
from uw_dslam_ros2.core.doctor.motions.fits import (
    SURE,
    VelocityFit,
    believed,
    confidence_of,
    fit_turns,
    fit_velocity,
)
from uw_dslam_ros2.core.doctor.motions.ping_motion import (
    PingMotions,
    far_ping_motions,
    ping_motions,
)
from uw_dslam_ros2.core.doctor.motions.turn_errors import fit_turn_errors
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample, PingSample

__all__ = ["examine"]

FloatArray = NDArray[np.float64]

_LIKELY = 0.95  # enough to tell of a late dvl, not to correct it
_MIN_MOTIONS = 15
_MIN_READINGS = 20
_UNIT_LOG = math.log(1.3)
_MAX_WAY_COST = 1.5  # of a velocity that explains how the echoes move
_FEET = 0.3048


def examine(
    navigation: NavigationSample,
    pings: PingSample,
    vehicle_id: str = "",
    odometry: OdometrySample | None = None,
) -> Examination:
    """Try the conventions of one vehicle's sensors.

    `pings` are bursts: each but the last of a burst has another about a second later.
    """
    result = Examination(pixels=pings.pixels or "", vehicle_id=vehicle_id)
    result.has_yaw = bool(np.isfinite(navigation.yaw_rad).any())
    result.has_yaw_rate = bool(np.isfinite(navigation.yaw_rate_rad_s).any())
    judge_images(result, pings)
    has_imu = len(navigation.imu_s) >= _MIN_READINGS
    has_odometry = odometry is not None and len(odometry.stamp_s) >= _MIN_READINGS
    if not has_imu and not has_odometry:
        return result
    motions = ping_motions(pings, 0.7, 2.1)
    result.num_ping_motions = len(motions)
    if odometry is not None and has_odometry:
        examine_odometry(result, odometry, motions, pings.T_base_sonar, is_alone=not has_imu)
    if not has_imu:
        return result
    imu = compare_yaw_and_rate(navigation.imu_s, navigation.yaw_rad, navigation.yaw_rate_rad_s)
    judge_imu(result, imu)
    navigation = without_spikes(without_zeros(result, navigation))
    if len(motions) >= _MIN_MOTIONS:
        _Trial(result, navigation, imu, motions, pings).run()
        return result
    # Echoes in feet go farther from ping to ping than a vehicle does.
    far = far_ping_motions(pings, 0.7, 2.1, _FEET)
    if len(far) >= _MIN_MOTIONS:
        by_far = copy.deepcopy(result)
        _Trial(by_far, navigation, imu, far, pings).run()
        if "sonar_range_factor" in by_far.mended:
            by_far.num_ping_motions = len(far)
            return by_far
    return result


@dataclass(frozen=True, slots=True)
class _Reading:
    """One way to read the sensors."""

    yaw_sign: int = 1
    is_sonar_mirrored: bool = False
    is_velocity_mirrored: bool = False
    is_velocity_in_world: bool = False


class _Trial:
    """The readings of one vehicle's sensors against the echoes' motion."""

    def __init__(
        self,
        result: Examination,
        navigation: NavigationSample,
        imu: ImuState,
        motions: PingMotions,
        pings: PingSample,
    ) -> None:
        self._result = result
        self._navigation = navigation
        self._imu = imu
        self._motions = motions
        self._mount, self._tilt_rad = pings.T_base_sonar, pings.tilt_rad
        self._yaw: FloatArray | None = None
        self._delay_s = 0.0
        self._side_confidence = 1.0
        self._start_s = pings.start_s

    def run(self) -> None:
        imu, imu_s = self._imu, self._navigation.imu_s
        rates, orientation = None, None
        if imu.by_rates is not None:
            in_degrees = self._result.conventions.imu_rates_in_degrees
            by_rates = imu.by_rates * (math.pi / 180.0 if in_degrees else 1.0)
            rates = believed(fit_turns(self._motions, imu_s, by_rates))
        if imu.by_orientation is not None:
            orientation = believed(fit_turns(self._motions, imu_s, imu.by_orientation))
        fits = rates or orientation
        if fits is None:
            judge_scale_of_turns(self._result, imu, self._motions, imu_s)
            return
        self._yaw = by_rates if rates else imu.by_orientation
        self._delay_s = fits[0].delay_s
        assert self._yaw is not None
        errors = fit_turn_errors(self._motions, imu_s, self._yaw, fits[0])
        if is_scale_of_turns_wrong(errors) and judge_scale_of_turns(
            self._result, imu, self._motions, imu_s
        ):
            return
        apart_rad_s = 0.0
        if rates and orientation and self._result.conventions.imu_orientation != "none":
            assert imu.by_orientation is not None
            side = rates[0].sign * orientation[0].sign
            apart = by_rates - side * imu.by_orientation
            apart_rad_s = float((apart[-1] - apart[0]) / (imu_s[-1] - imu_s[0]))
        reading: _Reading | None = _Reading(fits[0].sign)
        if rates and orientation and rates[0].sign != orientation[0].sign:
            say_one_flipped(self._result, rates[0].sign, orientation[0].sign, orientation)
        elif fits[0].sign < 0:
            reading = self._handedness()
        judge_drift(
            self._result, self._motions, imu_s, self._yaw, fits[0], errors, apart_rad_s,
            self._start_s, 0 if reading is None else reading.yaw_sign,
        )  # fmt: skip
        if reading is None:
            say_delays(self._result, find_delays(fits, lambda _: None, SURE, _LIKELY))
            return
        if reading == _Reading():
            plain = [self._fit(reading)]
            reading = self._velocity_in_world(reading, plain) or self._velocity_side(reading)
        chosen = reading
        delays = find_delays(fits, lambda late_s: self._fit(chosen, late_s), SURE, _LIKELY)
        fit = self._fit(chosen, delays.velocity_after_imu_s)
        self._result.is_velocity_judged = fit is not None
        if chosen.is_velocity_in_world:
            say_in_world(
                self._result,
                fit if self._imu.by_orientation is not None else None,
                self._side_confidence,
            )
        elif fit is not None and fit.is_mirrored:
            say_mirrored(self._result, fit, self._side_confidence)
        say_delays(self._result, delays)
        if fit is None:
            return
        if not chosen.is_velocity_in_world:
            if judge_current(self._result, fit):
                return
            late_s = delays.velocity_after_imu_s
            before = judge_knock(
                self._result,
                self._motions,
                self._navigation,
                self._start_s - self._result.conventions.sonar_delay_s,
                fit,
                lambda part: self._fit(chosen, late_s, part),
            )
            fit = before or fit
            if not fit.is_mirrored:
                judge_offset(self._result, fit, self._navigation.velocity_m_s)
        judge_scale(self._result, fit, self._tilt_rad)

    def _fit(
        self,
        reading: _Reading,
        velocity_delay_s: float = 0.0,
        motions: PingMotions | None = None,
    ) -> VelocityFit | None:
        yaw = self._yaw
        if reading.is_velocity_in_world and self._imu.by_orientation is not None:
            yaw = self._imu.by_orientation  # it is this that turns the velocity back
        assert yaw is not None
        yaw = reading.yaw_sign * yaw
        if reading.is_velocity_in_world and reading.yaw_sign < 0:
            yaw = yaw + 0.5 * math.pi  # a heading is counted from north
        return fit_velocity(
            self._motions if motions is None else motions,
            self._navigation,
            yaw,
            self._delay_s,
            sonar=complex(self._mount.x, self._mount.y),
            sonar_yaw_rad=self._mount.yaw,
            is_sonar_mirrored=reading.is_sonar_mirrored,
            is_velocity_mirrored=reading.is_velocity_mirrored,
            is_velocity_in_world=reading.is_velocity_in_world,
            velocity_delay_s=velocity_delay_s,
        )

    def _handedness(self) -> _Reading | None:
        """Say who is the wrong way round where the echoes turn against the IMU."""
        readings = _Reading(1, is_sonar_mirrored=True), _Reading(-1)
        sonar, imu = (self._fit(reading) for reading in readings)
        if (world := self._velocity_in_world(readings[1], [sonar, imu])) is not None:
            self._say_ned(
                "it turns against the sonar's echoes, and the dvl's velocity, along the world's "
                "axes, fits north, east, down (a mirrored sonar would make the mirror image of "
                "the same map)",
                self._side_confidence,
            )
            return world
        sure = 0.5
        if sonar is not None and imu is not None:
            sure = confidence_of(sonar, imu)
        if sonar is not None and sure > SURE:
            self._result.tell(
                "sonar_mirrored",
                "sonar",
                "its echoes turn against the imu and move sideways against the dvl: port and "
                "starboard are exchanged, or it hangs upside down "
                "(conventions.sonar_is_mirrored: true)",
                sure,
                sonar_is_mirrored=True,
            )
            return readings[0]
        if imu is not None and sure < 1.0 - SURE:
            self._say_ned(
                "it turns against the sonar's echoes, which move as the dvl says: its axes are "
                "forward, right, down in north, east, down",
                1.0 - sure,
            )
            return readings[1]
        self._result.tell(
            "handedness",
            "",
            "the sonar's echoes turn against the imu, and the dvl cannot tell which of them "
            "is the wrong way round: try conventions.sonar_is_mirrored: true, or "
            "conventions.imu_orientation: ned with conventions.imu_rates: frd",
            0.5,
        )
        return None

    def _say_ned(self, detail: str, confidence: float) -> None:
        changes = {"imu_orientation": "ned", "imu_rates": "frd"}
        if self._imu.by_orientation is None:
            del changes["imu_orientation"]
        if self._imu.by_rates is None:
            del changes["imu_rates"]
        mend = "(conventions.imu_orientation: ned, conventions.imu_rates: frd)"
        self._result.tell("imu_ned", "imu", f"{detail} {mend}", confidence, **changes)

    def _velocity_side(self, reading: _Reading) -> _Reading:
        """The reading, with the velocity's sideways axis the other way where that fits better."""
        other = replace(reading, is_velocity_mirrored=True)
        plain, mirrored = self._fit(reading), self._fit(other)
        if plain is None or mirrored is None:
            return reading
        self._side_confidence = confidence_of(mirrored, plain)
        return other if self._side_confidence > SURE else reading

    def _velocity_in_world(
        self, reading: _Reading, others: Sequence[VelocityFit | None]
    ) -> _Reading | None:
        """The reading along axes that do not turn with the vehicle, where only that fits.

        `others` are fits along the vehicle's own axes.
        """
        known = [fit for fit in others if fit is not None]
        readings = [
            replace(reading, is_velocity_mirrored=side, is_velocity_in_world=True)
            for side in (False, True)
        ]
        fits = [(own, fit) for own in readings if (fit := self._fit(own)) is not None]
        if not known or not fits:
            return None
        plain = min(known, key=lambda fit: float(np.nansum(fit.cost)))
        chosen, world = min(fits, key=lambda item: float(np.nansum(item[1].cost)))
        if abs(math.log(world.scale)) > _UNIT_LOG or np.nanmean(world.cost) > _MAX_WAY_COST:
            return None
        sure = confidence_of(world, plain)
        if sure <= SURE:
            return None
        self._side_confidence = sure
        return chosen
