"""What the examination finds is used where the settings leave it open."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.examining import examine_readings, mended
from uw_dslam_ros2.io.readings import ImuEvent


def test_an_imu_on_its_side_is_set_upright_before_it_is_judged():
    times_s = np.arange(0.0, 40.0, 0.1)
    yaws, rates = np.sin(0.3 * times_s), 0.3 * np.cos(0.3 * times_s)
    half = math.sqrt(0.5)

    def source(is_wanted):
        for seconds, yaw, rate in zip(times_s, yaws, rates, strict=True):
            c, s = half * math.cos(0.5 * yaw), half * math.sin(0.5 * yaw)
            # Turned by yaw about z, then by 90 degrees about its y: its x axis points down.
            q, stamp_ns = np.array([-s, c, s, c]), 10**12 + int(seconds * 1e9)
            if is_wanted("imu", stamp_ns):
                yield ImuEvent("auv_1", stamp_ns, "imu", q, None, np.array([-rate, 0.0, 0.0]))

    found = examine_readings(source, Conventions(), SonarConfig(), {}, lambda _: np.eye(4))
    assert [finding.kind for finding in found.findings] == ["imu_leans"]
    assert found.conventions.imu_pitch_rad == pytest.approx(0.5 * math.pi, abs=0.01)


def examination():
    found = Examination(sonar_changes={"intensity": "power"})
    found.add(Finding("imu_no_rates", "imu", "zero"), imu_rates="none")
    found.add(Finding("scale", "velocity", "long"))
    return found


def test_what_was_found_is_used_and_said_to_be():
    conventions, sonar, findings = mended(
        examination(), Conventions(), SonarConfig(min_range_m=1.0)
    )
    assert conventions == Conventions(imu_rates="none")
    assert sonar == SonarConfig(min_range_m=1.0, intensity="power")
    assert [finding.detail for finding in findings] == ["zero; it is mapped so", "long"]


def test_settings_are_followed_whatever_was_found():
    known = Conventions(imu_rates="frd")
    conventions, sonar, findings = mended(examination(), known, SonarConfig())
    assert (conventions, sonar) == (known, SonarConfig())
    assert [finding.detail for finding in findings] == ["zero", "long"]
