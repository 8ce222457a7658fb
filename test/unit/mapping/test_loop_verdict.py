"""The table of a loop: what is refused says by which number, and nothing unknown is closed."""

import math
import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from uw_dslam_ros2.core.mapping import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.config import LoopRegistrationConfig
from uw_dslam_ros2.core.mapping.loops import verdict as loop_verdict
from uw_dslam_ros2.core.mapping.loops.verdict import _RULES
from uw_dslam_ros2.core.mapping.scans.matcher import ScanMatch
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.registration.rules import first_that_applies
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.sim.maps.fleets import make_result

MATCH = ScanMatch(SE2(), 100.0 * np.eye(3), 0.9, 0.8, 0.5)


@dataclass(frozen=True)
class Case:
    """What the table asks, without the work."""

    guess: ScanMatch = MATCH
    judged: RegistrationResult = field(default_factory=lambda: make_result(SE2()))
    is_outside: bool = False
    offset: tuple[float, float] = (0.0, 0.0)
    conflict: float = 0.0
    match: ScanMatch = MATCH
    information: np.ndarray = field(default_factory=lambda: np.eye(3))
    sigma_m: float = 0.1
    found: SE2 = SE2()
    window: PriorWindow = field(default_factory=lambda: PriorWindow(SE2(), 1.0, 0.1))


def decided(case):
    rule = first_that_applies(_RULES, case)
    return rule.outcome, rule.sentence(case)


def judged(verdict):
    return replace(make_result(SE2()), verdict=verdict, reason="because")


def test_what_the_engine_accepts_is_closed():
    assert decided(Case())[0] is True
    assert decided(Case(is_outside=True))[0] is False


@pytest.mark.parametrize("verdict", [v for v in Verdict if v is not Verdict.ACCEPTED])
def test_what_it_does_not_accept_takes_a_sure_matcher_at_the_same_pose(verdict):
    is_open = verdict in (Verdict.AMBIGUOUS, Verdict.NOT_ENOUGH_OVERLAP, Verdict.IMPROBABLE)
    case = Case(judged=judged(verdict))
    assert decided(case)[0] is is_open
    for doubt in (
        {"guess": replace(MATCH, overlap=0.4)},
        {"guess": replace(MATCH, lead=0.01)},
        {"conflict": 0.2},
        {"offset": (0.5, 0.0)},
        {"offset": (0.0, 0.05)},
    ):
        assert decided(Case())[0] is decided(replace(Case(), **doubt))[0] is True
        assert decided(replace(case, **doubt))[0] is False


def test_each_line_decides_and_states_its_numbers(rng):
    deciding = set()
    for _ in range(4000):
        case = Case(
            guess=replace(MATCH, overlap=rng.random(), lead=rng.uniform(0.0, 0.3)),
            judged=judged(Verdict(rng.choice(list(Verdict)))),
            is_outside=bool(rng.random() < 0.2),
            offset=(rng.uniform(0.0, 0.4), rng.uniform(0.0, 0.03)),
            conflict=rng.uniform(0.0, 0.15),
            match=replace(MATCH, overlap=rng.random()),
        )
        spoilt = rng.random()
        if spoilt < 0.02:
            case = replace(case, guess=replace(MATCH, lead=math.nan))
        elif spoilt < 0.04:
            case = replace(case, match=replace(MATCH, information=np.full((3, 3), math.inf)))
        elif spoilt < 0.06:
            case = replace(case, information=np.full((3, 3), math.nan))
        elif spoilt < 0.08:
            refused = RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "few")
            case = replace(case, judged=refused)
        rule = first_that_applies(_RULES, case)
        deciding.add(_RULES.index(rule))
        said = re.search(r"([\d.]+)(%?), expected at (most|least) ([\d.]+)", rule.sentence(case))
        if said is not None:
            value, limit = float(said[1]), float(said[4])
            assert value > limit if said[3] == "most" else value < limit
            assert rule.outcome is False
    assert deciding == set(range(len(_RULES)))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["overlap", "score", "lead", "information"])
@pytest.mark.parametrize("which", ["guess", "match"])
def test_no_match_that_is_not_finite_closes_a_loop(which, name, bad):
    value = np.full((3, 3), bad) if name == "information" else bad
    is_closed, sentence = decided(replace(Case(), **{which: replace(MATCH, **{name: value})}))
    assert not is_closed
    assert "finite" in sentence


def test_no_information_that_is_not_finite_closes_a_loop():
    is_closed, sentence = decided(Case(information=np.full((3, 3), math.nan)))
    assert not is_closed
    assert "finite" in sentence


def test_settings_of_the_registration_reach_the_engine(tmp_path, monkeypatch):
    path = tmp_path / "settings.yaml"
    path.write_text("mapper: {loop: {registration: {max_false_accept: 0.1, min_overlap: 0.2}}}")
    config = SettingsFile(path).section(VehicleMapperConfig, "mapper", "/auv_1/sonar_mapper")
    expected = LoopRegistrationConfig(max_false_accept=0.1, min_overlap=0.2)
    assert config.loop.registration == expected
    assert expected.max_boxes == 20_000
    asked = []

    def engine(_source, _target, settings, *, prior):  # noqa: ARG001 (the form of the engine)
        asked.append(settings)
        return RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "few")

    monkeypatch.setattr(loop_verdict, "register_grids", engine)
    case = object.__new__(loop_verdict.LoopCase)
    case.config, case.window = config, None
    case.source = case.target = _Empty()
    assert case.judged.verdict is Verdict.TOO_FEW_FEATURES
    assert asked == [expected]


class _Empty:
    """A submap of which nothing is asked."""

    grid = property(lambda self: self)

    def decompressed(self):
        return self

    def to_occupancy(self, _log_odds_max):
        return None
