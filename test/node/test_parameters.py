"""Settings as parameters: text, ranges, refusals."""

from dataclasses import dataclass

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.parameter import Parameter

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters

pytestmark = pytest.mark.ros


@dataclass(frozen=True, slots=True)
class Inner(Config):
    length_m: float = setting(25.0, 1.0, 1000.0, "path length [m]")


@dataclass(frozen=True, slots=True)
class Outer(Config):
    count: int = setting(3, 1, 10, "how many")
    is_on: bool = setting(True, doc="a switch")
    method: str = setting("cfar", choices=("cfar", "fixed"), doc="how")
    names: tuple[str, ...] = setting((), doc="who")
    weights: tuple[float, ...] = setting((1.0, 2.0), doc="how much")
    inner: Inner = Inner()


@pytest.fixture
def declare(ros_context):
    nodes = []

    def make(**overrides):
        parameters = [Parameter(k.replace("__", "."), value=v) for k, v in overrides.items()]
        node = rclpy.create_node("n", context=ros_context, parameter_overrides=parameters)
        nodes.append(node)
        config = declare_config(node, Outer, "group")
        refuse_unknown_parameters(node)
        return node, config

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_are_the_cores(declare):
    _, config = declare()
    assert config == Outer()


def test_given_values_reach_the_settings(declare):
    _, config = declare(
        group__count=7,
        group__inner__length_m=50.0,
        group__names=["a", "b"],
        group__weights=[0.5],
        group__method="fixed",
    )
    assert (config.count, config.inner.length_m) == (7, 50.0)
    assert (config.names, config.weights, config.method) == (("a", "b"), (0.5,), "fixed")


def test_parameters_carry_text_and_range_and_are_read_only(declare):
    node, _ = declare()
    descriptor = node.describe_parameter("group.inner.length_m")
    assert descriptor.description == "path length [m]"
    bounds = descriptor.floating_point_range[0]
    assert (bounds.from_value, bounds.to_value) == (1.0, 1000.0)
    assert descriptor.read_only
    assert node.describe_parameter("group.count").integer_range[0].to_value == 10
    assert "cfar, fixed" in node.describe_parameter("group.method").additional_constraints
    assert not node.set_parameters([Parameter("group.count", value=5)])[0].successful


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("group__count", 11, ["group.count", "11", "1 to 10"]),
        ("group__inner__length_m", 0.5, ["group.inner.length_m", "0.5", "1.0 to 1000.0"]),
        ("group__inner__length_m", 12, ["group.inner.length_m", "12", "double", "write 12.0"]),
        ("group__count", "three", ["group.count", "'three'", "integer"]),
        ("group__method", "best", ["group.method", "'best'", "cfar, fixed"]),
        ("group__cuont", 5, ["group.cuont", "unknown", "did you mean group.count"]),
        ("gruop__count", 5, ["gruop.count", "unknown", "group.count"]),
        ("count", 5, ["count", "unknown"]),
        ("qos_overrides__submap__publisher__depth", 5, ["qos_overrides.submap", "change nothing"]),
    ],
)
def test_bad_parameter_is_refused_by_name(declare, name, value, words):
    with pytest.raises(ConfigError) as error:
        declare(**{name: value})
    for word in words:
        assert word in str(error.value)


def test_groups_of_other_nodes_are_skipped(declare):
    _, config = declare(queue__mode="graph", use_sim_time=True)
    assert config == Outer()
