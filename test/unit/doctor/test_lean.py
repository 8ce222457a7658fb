"""IMUs that are mounted on their side, or whose quaternion is in another order."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.doctor.examination import ScaleEstimate
from uw_dslam_ros2.core.doctor.judging.lean import Lean
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.io.conventions import CorrectedMountings, correct
from uw_dslam_ros2.io.readings import ImuEvent

YAWS = np.linspace(-2.0, 2.5, 40)


def quaternion(axis, angle):
    return np.append(math.sin(0.5 * angle) * np.array(axis), math.cos(0.5 * angle))


def product(a, b):
    v, w = a[:3], a[3]
    return np.append(w * b[:3] + b[3] * v + np.cross(v, b[:3]), w * b[3] - v @ b[:3])


def event(q, rates=None):
    return ImuEvent("auv_1", 1, "imu", q, None, rates)


def found_of(orientations, mounting=np.eye(3)):  # noqa: B008 (not changed)
    lean = Lean()
    for q in orientations:
        lean.add(q, mounting)
    found = Examination()
    lean.tell(found)
    return found


def turned_by(axis, angle):
    return [product(quaternion([0, 0, 1], yaw), quaternion(axis, angle)) for yaw in YAWS]


@pytest.mark.parametrize(
    ("axis", "angle"),
    [
        ([1, 0, 0], math.pi),
        ([0, 1, 0], -1.5),
        ([0, 1, 0], 1.5),
        ([1, 0, 0], 1.3),
        ([0.6, 0.8, 0], 2),
    ],
)
def test_an_imu_on_its_side_is_set_upright(axis, angle):
    orientations = turned_by(axis, angle)
    found = found_of(orientations)
    assert [f.kind for f in found.findings] == ["imu_leans"]
    corrected = CorrectedMountings(found.conventions)
    headings = []
    for q in orientations:
        mounting = corrected.of(event(q), np.eye(4))[:3, :3]
        R_world_base = rotation_of_quaternion(q) @ mounting.T
        assert R_world_base[2, 2] > 0.999
        headings.append(math.atan2(R_world_base[1, 0], R_world_base[0, 0]))
    np.testing.assert_allclose(np.diff(np.unwrap(headings)), np.diff(YAWS), atol=1e-2)


def test_a_quaternion_that_begins_with_w_is_read_so():
    orientations = [quaternion([0, 0, 1], yaw) for yaw in YAWS]
    found = found_of([np.roll(q, 1) for q in orientations])
    assert found.conventions == Conventions(imu_orientation="wxyz")
    for q in orientations:
        read = correct(event(np.roll(q, 1)), found.conventions)
        np.testing.assert_allclose(read.orientation_xyzw, q)


def test_nothing_is_said_of_a_vehicle_that_leans_little_or_as_tf_says():
    assert found_of(turned_by([0, 1, 0], 0.2)).findings == []
    upside_down = np.diag([1.0, -1.0, -1.0])
    assert found_of(turned_by([1, 0, 0], math.pi), upside_down).findings == []
    assert found_of(turned_by([1, 0, 0], math.pi)[:5]).findings == []


@pytest.mark.parametrize(("ratio", "is_mended"), [(1.01, True), (1.13, False), (None, False)])
def test_a_slight_lean_is_mended_only_where_the_echoes_move_as_a_level_vehicles(ratio, is_mended):
    lean = Lean()
    for q in turned_by([0, 1, 0], math.radians(20.0)):
        lean.add(q, np.eye(3))
    assert lean.changes() == {}
    found = Examination()
    found.scale = None if ratio is None else ScaleEstimate(ratio, 0.003, "velocity")
    lean.tell_slight(found)
    assert [f.kind for f in found.findings] == ["imu_leans"]
    expected = {"imu_pitch_rad": pytest.approx(math.radians(20.0), abs=1e-3)} if is_mended else {}
    assert found.conventions.changes() == expected
    level = Lean()
    for q in turned_by([0, 1, 0], math.radians(8.0)):
        level.add(q, np.eye(3))
    level.tell_slight(found)
    assert len(found.findings) == 1


def test_orientations_that_tumble_are_not_used(rng):
    tumbling = [q / np.linalg.norm(q) for q in rng.normal(size=(60, 4))]
    assert found_of(tumbling).conventions == Conventions(imu_orientation="none")
