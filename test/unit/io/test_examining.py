"""What the examination finds is used where the settings leave it open."""

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.examining import mended


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
