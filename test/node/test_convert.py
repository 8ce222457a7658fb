"""Messages to core types and back, checked against literal numbers in each direction."""

import array
import math

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import Point32
from nav_msgs.msg import OccupancyGrid
from uw_dslam_msgs.msg import Registration, RegistrationOptions
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    RegistrationResult,
    Rival,
    Verdict,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_from_msg,
    occupancy_to_msg,
    path_to_msg,
    stamp_ns_from_msg,
    stamp_to_msg,
    submap_from_msg,
    submap_to_msg,
)
from uw_dslam_ros2.ros.convert.merging import answer_from_msg, answer_to_msg
from uw_dslam_ros2.ros.convert.registration import (
    options_from_msg,
    options_to_msg,
    registration_from_msg,
    registration_to_msg,
)

pytestmark = pytest.mark.ros

ROWS = [[0, 100, -1, 50], [-1, -1, 10, 20], [30, 40, 60, 70]]  # 3 rows, 4 columns, asymmetric
FLAT = [0, 100, -1, 50, -1, -1, 10, 20, 30, 40, 60, 70]


def grid_msg():
    msg = OccupancyGrid()
    msg.info.resolution = 0.05
    msg.info.width, msg.info.height = 4, 3
    msg.info.origin.position.x, msg.info.origin.position.y = 1.5, -2.5
    msg.data = array.array("b", FLAT)
    return msg


def test_grid_message_is_read_row_by_row():
    occupancy = occupancy_from_msg(grid_msg())
    assert occupancy.values.tolist() == ROWS
    assert occupancy.spec == GridSpec(0.05, 3, 4, SE2(1.5, -2.5, 0.0))


def test_grid_message_is_written_row_by_row():
    spec = GridSpec(0.05, 3, 4, SE2(1.5, -2.5, 0.0))
    msg = occupancy_to_msg(OccupancyMap(spec, np.array(ROWS, np.int8)), "auv_1/map", 1_500_000_000)
    assert list(msg.data) == FLAT
    assert (msg.info.width, msg.info.height, msg.info.resolution) == (4, 3, 0.05)
    assert (msg.info.origin.position.x, msg.info.origin.position.y) == (1.5, -2.5)
    assert (msg.info.origin.orientation.z, msg.info.origin.orientation.w) == (0.0, 1.0)
    assert msg.header.frame_id == "auv_1/map"
    assert (msg.header.stamp.sec, msg.header.stamp.nanosec) == (1, 500_000_000)


def test_values_that_are_not_contiguous_are_written_right():
    values = np.array(ROWS, np.int8)[:, ::-1]
    msg = occupancy_to_msg(OccupancyMap(GridSpec(1.0, 3, 4), values), "map", 0)
    assert list(msg.data[:4]) == [50, -1, 100, 0]


def test_rotated_origin_is_honoured():
    msg = grid_msg()
    # A quarter turn: the grid's column axis points along +y, its row axis along -x.
    msg.info.origin.orientation.z = msg.info.origin.orientation.w = math.sqrt(0.5)
    occupancy = occupancy_from_msg(msg)
    np.testing.assert_allclose(
        occupancy.spec.centers_of([[0, 3]]), [[1.5 - 0.025, -2.5 + 0.175]], atol=1e-9
    )
    again = occupancy_from_msg(occupancy_to_msg(occupancy, "map", 0))
    assert again.spec.T_frame_grid.yaw == pytest.approx(math.pi / 2)


def test_resolution_survives_the_wire_as_the_decimal_that_was_meant():
    from rclpy.serialization import deserialize_message, serialize_message

    wired = deserialize_message(serialize_message(grid_msg()), OccupancyGrid)
    assert wired.info.resolution != 0.05  # it is a float32
    assert occupancy_from_msg(wired).spec.resolution_m == 0.05


def damage(field, value):
    def apply(msg):
        *path, name = field.split(".")
        owner = msg
        for part in path:
            owner = getattr(owner, part)
        setattr(owner, name, value)

    return apply


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("info.width", 0, ["info.width", "0", "at least 1"]),
        ("info.height", 0, ["info.height", "0", "at least 1"]),
        ("info.width", 5, ["data", "12", "15"]),
        ("data", array.array("b"), ["data", "0 values", "12"]),
        ("info.resolution", 0.0, ["info.resolution", "0.0", "positive"]),
        ("info.resolution", -0.05, ["info.resolution", "-0.05", "positive"]),
        ("info.resolution", float("nan"), ["info.resolution", "nan", "positive"]),
        ("info.origin.position.x", float("nan"), ["origin.position.x", "nan", "finite"]),
        ("info.origin.position.y", float("inf"), ["origin.position.y", "inf", "finite"]),
        ("info.origin.orientation.w", 0.0, ["origin.orientation", "norm 0", "norm 1"]),
        ("info.origin.orientation.z", float("nan"), ["origin.orientation", "nan", "norm 1"]),
        (
            "data",
            array.array("b", [*FLAT[:6], 101, *FLAT[7:]]),
            ["data", "101", "row 1", "0..100"],
        ),
        ("data", array.array("b", [*FLAT[:11], -2]), ["data", "-2", "column 3", "-1 or"]),
    ],
)
def test_damaged_grid_is_refused_naming_field_value_and_expectation(field, value, words):
    msg = grid_msg()
    damage(field, value)(msg)
    with pytest.raises(InvalidInputError) as error:
        occupancy_from_msg(msg, "source")
    assert str(error.value).startswith("source.")
    for word in words:
        assert word in str(error.value)


def test_tilted_origin_is_refused():
    msg = grid_msg()
    msg.info.origin.orientation.x = math.sin(0.1)
    msg.info.origin.orientation.w = math.cos(0.1)
    with pytest.raises(InvalidInputError, match=r"tilted by 11.5 degrees, expected"):
        occupancy_from_msg(msg)


def make_submap():
    return Submap(
        vehicle_id="auv_1",
        sequence=3,
        revision=2,
        is_final=True,
        stamp_ns=12_000_000_034,
        T_odom_submap=SE2(4.0, 5.0, -0.5),
        covariance=np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]),
        grid=OccupancyMap(GridSpec(0.1, 3, 4, SE2(-0.2, -0.1, 0.0)), np.array(ROWS, np.int8)),
        points=np.array([[0.5, 0.25], [-1.0, 2.0]]),
        trajectory=np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.25]]),
        trajectory_stamp_ns=np.array([11_000_000_000, 12_000_000_034]),
    )


def test_submap_message_has_every_field_in_its_place():
    msg = submap_to_msg(make_submap())
    assert msg.header.frame_id == msg.grid.header.frame_id == "auv_1/submap_3"
    assert (msg.vehicle_id, msg.sequence, msg.revision, msg.is_final) == ("auv_1", 3, 2, True)
    assert (msg.pose.pose.position.x, msg.pose.pose.position.y) == (4.0, 5.0)
    covariance = np.array(msg.pose.covariance).reshape(6, 6)
    assert covariance[0, 5] == covariance[5, 0] == 0.2
    assert covariance[1, 1] == 2.0
    assert covariance[5, 5] == 3.0
    assert covariance[2:5].sum() == 0.0
    assert msg.points[1] == Point32(x=-1.0, y=2.0, z=0.0)
    assert msg.trajectory[1].pose.position.y == 0.5
    assert stamp_ns_from_msg(msg.trajectory[1].header.stamp) == 12_000_000_034


def test_submap_comes_back_from_the_wire():
    from rclpy.serialization import deserialize_message, serialize_message

    submap = make_submap()
    again = submap_from_msg(
        deserialize_message(serialize_message(submap_to_msg(submap)), SubmapMsg)
    )
    assert again.submap_id == submap.submap_id
    assert (again.revision, again.is_final, again.stamp_ns) == (2, True, 12_000_000_034)
    assert again.T_odom_submap.distance_to(submap.T_odom_submap) == pytest.approx((0.0, 0.0))
    np.testing.assert_array_equal(again.covariance, submap.covariance)
    np.testing.assert_array_equal(again.grid.values, submap.grid.values)
    assert again.grid.spec == submap.grid.spec
    np.testing.assert_array_equal(again.points, submap.points)
    np.testing.assert_allclose(again.trajectory, submap.trajectory, atol=1e-12)
    np.testing.assert_array_equal(again.trajectory_stamp_ns, submap.trajectory_stamp_ns)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: setattr(m, "vehicle_id", ""), "vehicle_id is ''"),
        (lambda m: setattr(m, "vehicle_id", "/auv_1"), "vehicle_id is '/auv_1'"),
        (lambda m: setattr(m.pose.pose.position, "x", math.nan), "pose.pose.position.x is nan"),
        (lambda m: setattr(m.pose, "covariance", [-1.0] * 36), "pose.covariance has variances"),
        (lambda m: setattr(m.points[0], "x", math.inf), "points hold"),
        (lambda m: setattr(m.grid.info, "width", 0), "grid.info.width is 0"),
        (
            lambda m: setattr(m.trajectory[1].pose.orientation, "w", 0.0),
            r"trajectory\[1\].pose.orientation",
        ),
    ],
)
def test_damaged_submap_is_refused_by_name(change, words):
    msg = submap_to_msg(make_submap())
    change(msg)
    with pytest.raises(InvalidInputError, match=words):
        submap_from_msg(msg)


def make_result(verdict=Verdict.ACCEPTED):
    return RegistrationResult(
        verdict=verdict,
        reason="because",
        T_target_source=SE2(1.0, -2.0, 3.0),
        covariance=np.arange(9.0).reshape(3, 3),
        probability=0.9,
        score=0.8,
        lower_bound=0.75,
        upper_bound=1.0,
        is_certified=True,
        num_boxes=1234,
        seconds=0.5,
        overlap=0.6,
        conflict_ratio=0.01,
        inlier_ratio=0.7,
        num_source_points=50,
        num_target_points=60,
        rivals=(Rival(SE2(5.0, 6.0, -1.0), 0.5, 0.55),),
    )


def test_registration_goes_both_ways():
    msg = registration_to_msg(make_result())
    assert msg.verdict == Registration.ACCEPTED
    assert msg.gap == pytest.approx(0.25)
    assert list(msg.covariance) == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert (msg.rivals[0].t_target_source.y, msg.rivals[0].upper_bound) == (6.0, 0.55)
    again = registration_from_msg(msg)
    for name in ("verdict", "reason", "T_target_source", "num_boxes", "overlap", "rivals", "gap"):
        assert getattr(again, name) == getattr(make_result(), name)


@pytest.mark.parametrize("verdict", list(Verdict))
def test_verdicts_are_those_of_the_message(verdict):
    assert getattr(Registration, verdict.name) == verdict.value
    assert registration_from_msg(registration_to_msg(make_result(verdict))).verdict is verdict


def test_a_refusal_without_a_pose_goes_both_ways_and_names_no_place():
    refused = RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "3 points", num_points=(3, 9))
    msg = registration_to_msg(refused)
    assert all(math.isnan(value) for value in (*transform_values(msg), *msg.covariance))
    assert (msg.probability, msg.lower_bound, msg.upper_bound, msg.gap) == (0.0, 0.0, 1.0, 1.0)
    again = registration_from_msg(msg)
    assert again.T_target_source is None
    assert (again.verdict, again.num_target_points) == (Verdict.TOO_FEW_FEATURES, 9)


@pytest.mark.parametrize("verdict", list(Verdict))
def test_half_a_transform_is_refused_and_so_is_none_that_is_accepted(verdict):
    msg = registration_to_msg(make_result(verdict))
    msg.t_target_source.x = math.nan
    with pytest.raises(InvalidInputError, match=r"t_target_source\.x is nan"):
        registration_from_msg(msg)
    msg.t_target_source.y = msg.t_target_source.yaw = math.nan
    if verdict is Verdict.ACCEPTED:
        with pytest.raises(InvalidInputError, match=r"t_target_source\.x is nan"):
            registration_from_msg(msg)
    else:
        assert registration_from_msg(msg).T_target_source is None


def transform_values(msg):
    return msg.t_target_source.x, msg.t_target_source.y, msg.t_target_source.yaw


def test_registration_that_nobody_filled_in_is_refused():
    with pytest.raises(InvalidInputError, match="verdict is 0, expected 1 to 7"):
        registration_from_msg(Registration())


def test_options_go_both_ways():
    prior = PriorWindow(SE2(1.0, 2.0, 0.5), 3.0, 0.25)
    assert options_from_msg(options_to_msg(prior, 2.0)) == (prior, 2.0)
    assert options_from_msg(RegistrationOptions()) == (None, 0.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("prior_half_width_m", 0.0),
        ("prior_half_width_m", math.nan),
        ("prior_half_width_rad", 4.0),
        ("max_seconds", -1.0),
        ("max_seconds", math.inf),
    ],
)
def test_bad_options_are_refused_by_name(field, value):
    msg = options_to_msg(PriorWindow(SE2(), 1.0, 1.0))
    setattr(msg, field, value)
    with pytest.raises(InvalidInputError, match=f"options.{field} is"):
        options_from_msg(msg)


@pytest.mark.parametrize("stamp_ns", [0, 1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789])
def test_stamps_go_both_ways(stamp_ns):
    assert stamp_ns_from_msg(stamp_to_msg(stamp_ns)) == stamp_ns


def test_long_path_is_thinned_between_its_ends():
    stamps_ns = np.arange(1000) * 1_000_000
    poses = np.column_stack([np.arange(1000.0), np.zeros(1000), np.zeros(1000)])
    path = path_to_msg(stamps_ns, poses, "auv_1/map", 5, max_poses=10)
    xs = [pose.pose.position.x for pose in path.poses]
    assert len(xs) == 10
    assert (xs[0], xs[-1]) == (0.0, 999.0)
    assert xs == sorted(set(xs))


# --- answers of the queue --------------------------------------------------------------------


def group(vehicle_id, *places):
    members = {SubmapId(vehicle_id, 7, i): place for i, place in enumerate(places)}
    return SubmapGroup(SubmapId(vehicle_id, 7, 1), members, b"key")


@pytest.mark.parametrize("motion", [SE2(1.0, -2.0, 0.5), None])
@pytest.mark.parametrize("prior", [PriorWindow(SE2(3.0, 4.0, 0.1), 2.0, 0.25), None])
def test_an_answer_comes_back_as_it_went(motion, prior):
    source = group("auv_1", SE2(-1.0, 0.0, 0.1), SE2())
    target = group("auv_2", SE2(0.0, 5.0, 0.0), SE2(), SE2(2.0, 0.0, -0.3))
    numbers = {"score": 0.5, "lower_bound": 0.5, "upper_bound": 0.505, "is_certified": 1.0}
    numbers |= {"num_boxes": 12.0, "num_source_points": 3.0, "num_target_points": 4.0}
    covariance = np.diag([0.1, 0.2, 0.3]) if motion else np.full((3, 3), np.nan)
    verdict = Verdict.ACCEPTED if motion else Verdict.TOO_FEW_FEATURES
    probability = 0.9 if motion else 0.0
    sent = Answer(
        Query(source, target, prior), verdict, "why", motion, covariance, probability, numbers
    )
    msg = answer_to_msg(sent, True)
    assert msg.answer.gap == pytest.approx(0.005 / 0.505)
    assert (msg.source_reference, msg.target_reference) == (1, 1)
    found, is_used = answer_from_msg(msg)
    assert is_used
    assert (found.verdict, found.reason, found.T_target_source) == (verdict, sent.why, motion)
    assert (found.probability, found.numbers) == (probability, numbers)
    np.testing.assert_array_equal(found.covariance, covariance)
    for name in ("source", "target"):
        one, other = getattr(sent.query, name), getattr(found.query, name)
        assert (one.reference, one.T_reference_submap) == (
            other.reference,
            other.T_reference_submap,
        )
    assert (found.query.prior is None) == (prior is None)
    if prior:
        assert found.query.prior == prior


def test_answers_that_point_nowhere_are_refused():
    sent = Answer(
        Query(group("a", SE2(), SE2()), group("b", SE2(), SE2())),
        Verdict.ACCEPTED, "", SE2(), np.eye(3), 0.9,
    )  # fmt: skip
    for field, value, said in (
        ("source_reference", 2, "source_reference is 2"),
        ("answer", Registration(), "answer.verdict is 0"),
    ):
        msg = answer_to_msg(sent, False)
        setattr(msg, field, value)
        with pytest.raises(InvalidInputError, match=said):
            answer_from_msg(msg)
