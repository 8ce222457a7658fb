"""TUM and g2o files against literal text, in each direction."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.trajectories import PoseGraphEdge, read_g2o, read_tum, write_g2o, write_tum

STAMP_NS = 1_700_000_000_123_456_789


def test_tum_is_written_as_literal_text(tmp_path):
    path = write_tum(
        tmp_path / "a.tum", np.array([STAMP_NS]), np.array([[1.5, -2.0, math.pi / 2]])
    )
    expected = (
        "1700000000.123456789 1.500000000 -2.000000000 0 0 0 0.707106781187 0.707106781187\n"
    )
    assert path.read_text() == expected


def test_tum_is_read_to_the_nanosecond(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text(
        "# a comment\n\n1700000000.123456789 1.5 -2 7 0 0 1.0 1.0\n1.7e9 0 0 0 0 0 0 1\n"
    )
    stamps_ns, poses = read_tum(path)
    assert stamps_ns.tolist() == [STAMP_NS, 1_700_000_000_000_000_000]
    np.testing.assert_allclose(poses, [[1.5, -2.0, math.pi / 2], [0.0, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1 2 3\n", "a.tum:1 has 3 numbers, expected 8"),
        ("0 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n", "a.tum:2: time is 'x'"),
        ("0 a 0 0 0 0 0 1\n", "a.tum:1: 'a' is not a number"),
        ("0 nan 0 0 0 0 0 1\n", "a.tum:1: 'nan' is not finite"),
        ("0 0 0 0 0 0 0 0\n", "quaternion is zero"),
    ],
)
def test_bad_tum_lines_are_named(tmp_path, text, sentence):
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(DataError) as caught:
        read_tum(tmp_path / "a.tum")
    assert sentence in str(caught.value)


def test_tum_refuses_wrong_shapes_and_times_before_zero(tmp_path):
    with pytest.raises(InvalidInputError, match="expected \\(2, 3\\)"):
        write_tum(tmp_path / "a.tum", np.array([1, 2]), np.zeros((1, 3)))
    with pytest.raises(InvalidInputError, match="stamp is -1 ns"):
        write_tum(tmp_path / "a.tum", np.array([-1]), np.zeros((1, 3)))


def test_g2o_is_written_as_literal_text(tmp_path):
    """At a quarter turn the source's x axis is the target's y: the information changes places."""
    vertices = {0: SE2(), 3: SE2(1.0, 2.0, math.pi / 2)}
    edge = PoseGraphEdge(0, 3, SE2(1.0, 2.0, math.pi / 2), np.diag([0.25, 0.5, 0.01]))
    text = write_g2o(tmp_path / "a.g2o", vertices, [edge]).read_text().splitlines()
    assert text[:2] == ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 3 1 2 1.57079632679"]
    words = text[2].split()
    assert words[:5] == ["EDGE_SE2", "0", "3", "1", "2"]
    np.testing.assert_allclose(
        [float(w) for w in words[6:]], [2.0, 0.0, 0.0, 4.0, 0.0, 100.0], atol=1e-9
    )


def test_g2o_is_read_from_literal_text(tmp_path):
    (tmp_path / "a.g2o").write_text(
        "FIX 0\nVERTEX_SE2 0 0 0 0\nVERTEX_SE2 3 1 2 1.5707963267948966\n"
        "EDGE_SE2 0 3 1 2 1.5707963267948966 2 0 0 4 0 100\n"
    )
    vertices, (edge,) = read_g2o(tmp_path / "a.g2o")
    assert vertices == {0: SE2(), 3: SE2(1.0, 2.0, math.pi / 2)}
    assert (edge.target, edge.source, edge.T_target_source) == (0, 3, SE2(1.0, 2.0, math.pi / 2))
    np.testing.assert_allclose(edge.covariance, np.diag([0.25, 0.5, 0.01]), atol=1e-12)


def test_the_information_in_a_g2o_file_weighs_errors_as_our_covariance_does(tmp_path):
    measured, covariance = (
        SE2(1.1, 2.1, 0.8),
        np.array([[0.2, 0.05, 0.01], [0.05, 0.3, 0.0], [0.01, 0.0, 0.02]]),
    )
    path = tmp_path / "a.g2o"
    write_g2o(path, {0: SE2(), 1: measured}, [PoseGraphEdge(0, 1, measured, covariance)])
    numbers = [float(word) for word in path.read_text().splitlines()[2].split()[6:]]
    information = np.zeros((3, 3))
    information[np.triu_indices(3)] = numbers
    information += np.triu(information, 1).T
    moved = np.array([1e-4, -2e-4, 3e-4])
    # g2o's error of an EDGE_SE2: what is left of the poses' motion after the measured one.
    error = (measured.inverse() @ SE2.from_array(measured.as_array() + moved)).as_array()
    expected = moved @ np.linalg.inv(covariance) @ moved
    assert error @ information @ error == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("VERTEX_SE2 0 0 0\n", "a.g2o:1: VERTEX_SE2 has 3 values, expected 4"),
        ("VERTEX_SE2 a 0 0 0\n", "'a' is not a vertex number"),
        ("EDGE_SE2 0 1 0 0 0 1 0 0 -1 0 1\n", "not positive definite"),
    ],
)
def test_bad_g2o_lines_are_named(tmp_path, text, sentence):
    (tmp_path / "a.g2o").write_text(text)
    with pytest.raises(DataError) as caught:
        read_g2o(tmp_path / "a.g2o")
    assert sentence in str(caught.value)


def test_an_edge_to_nowhere_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="names vertex 1"):
        write_g2o(tmp_path / "a.g2o", {0: SE2()}, [PoseGraphEdge(0, 1, SE2(), np.eye(3))])
