"""What a page or a file says of a decision is taken as it is, or refused by name."""

import json
import math

import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import Decision, DecisionKind
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.sessions.decisions import decision_from_plain, decision_to_plain

ONE, OTHER = SubmapId("auv_1", 0, 3), SubmapId("b<c>", 7, 0)
DECISIONS = [
    Decision(DecisionKind.WITHDRAW, "Ann", 5, ONE, is_run=True, number=1),
    Decision(DecisionKind.FORBID, "Ann", 5, ONE, OTHER),
    Decision(
        DecisionKind.CONFIRM, "", 0, ONE, OTHER, False, SE2(1.0, 2.0, 3.0), 0.5, 0.25, number=4
    ),
    Decision(
        DecisionKind.FIX, "Bo", 5, ONE, sigma_m=2.0, sigma_rad=math.inf, place=SE2(5e5, 5e6),
        earth_frame="EPSG:32632", point=(1.5, -2.0),
    ),
    Decision(DecisionKind.UNDO, "Bo", 6, undone=3, number=9),
]  # fmt: skip


@pytest.mark.parametrize("decision", DECISIONS, ids=lambda d: d.kind.name)
def test_a_decision_comes_back_through_strict_json(decision):
    text = json.dumps(decision_to_plain(decision), allow_nan=False)
    assert decision_from_plain(json.loads(text)) == decision


@pytest.mark.parametrize(
    ("plain", "message"),
    [
        ({}, "kind is None, expected one of withdraw, "),
        ({"kind": "destroy"}, "kind is 'destroy'"),
        ({"kind": "pin", "source": "auv_1"}, "source is 'auv_1', expected a vehicle"),
        ({"kind": "pin", "source": ["auv_1", 0, True]}, "expected a vehicle"),
        ({"kind": "pin", "source": ["a", 0, 0], "who": 5}, "who is 5, expected str"),
        ({"kind": "pin", "source": ["a", 0, 0], "extra": 5}, r"holds \['extra'\]"),
        ({"kind": "undo", "undone": 1.5}, "undone is 1.5, expected int"),
        ({"kind": "withdraw", "source": ["a", 0, 0], "is_run": 1}, "is_run is 1, expected bool"),
        ({"kind": "fix", "source": ["a", 0, 0], "place": [1, 2]}, "place is .*expected 3 numbers"),
        ({"kind": "fix", "source": ["a", 0, 0], "place": [1, 2, math.nan]}, "finite"),
    ],
)
def test_nonsense_is_refused_by_name(plain, message):
    with pytest.raises(InvalidInputError, match=message):
        decision_from_plain(plain)
