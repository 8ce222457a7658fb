"""Settings refuse what they do not know."""

from dataclasses import dataclass

import pytest

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Inner(Config):
    sigma_m: float = setting(0.1, 0.01, 1.0, "width")


@dataclass(frozen=True, slots=True)
class Outer(Config):
    count: int = setting(3, 1, 10, "how many")
    method: str = setting("a", choices=("a", "b"), doc="which")
    is_on: bool = setting(True, doc="whether")
    inner: Inner = setting(Inner())


def test_plain_values_make_nested_settings_and_back():
    values = {"count": 4, "method": "b", "is_on": False, "inner": {"sigma_m": 0.5}}
    assert Outer.from_dict(values).to_dict() == values
    assert Outer.from_dict({}) == Outer()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cuont": 3}, "no setting 'cuont'; it has count, inner"),
        ({"count": 11}, r"Outer\.count is 11, expected 1 to 10"),
        ({"count": 2.0}, r"Outer\.count is 2\.0 \(float\), expected int"),
        ({"count": True}, r"Outer\.count is True \(bool\), expected int"),
        ({"method": "c"}, r"Outer\.method is 'c', expected one of a, b"),
        ({"inner": 3}, r"Outer\.inner is 3, expected a mapping"),
        ({"inner": {"sigma_m": float("nan")}}, r"Inner\.sigma_m is nan, expected a finite"),
        ({"inner": {"sigma_m": "0.1"}}, r"Inner\.sigma_m is '0\.1' \(str\), expected float"),
    ],
)
def test_a_bad_setting_is_named_with_its_value(values, message):
    with pytest.raises(ConfigError, match=message):
        Outer.from_dict(values)


def test_a_whole_number_serves_as_a_float():
    assert Inner(sigma_m=1).sigma_m == 1.0
