"""The report says what happened, the bad things too."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.cli.reporting import map_drawing, pictures
from uw_dslam_ros2.cli.reporting.outcome import Outcome, outcome_of
from uw_dslam_ros2.cli.reporting.report import RunFacts, headline, write_report
from uw_dslam_ros2.cli.reporting.scoring import Scores, Truth, read_truth, score
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import Decision, DecisionKind, SubmapRecord
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.maps.files import read_map, write_map
from uw_dslam_ros2.io.trajectories import write_tum
from uw_dslam_ros2.view.queue_source import QueueSource

FACTS = RunFacts(
    "A <title>", ["bag_1"], "offline", {"queue": {"mode": "graph"}}, {"mission": 3}, {}
)


def _scores(truth: Truth | None) -> Scores:
    outcome = missions.outcome()
    own = {v.vehicle_id: v.own_trajectory for v in outcome.vehicles}
    return score(outcome.global_map, outcome.trajectories(), own, truth)


def test_a_planted_merge_has_no_error() -> None:
    scores = _scores(missions.truth())
    assert scores.trajectory is not None
    assert scores.trajectory.rmse_m < 1e-3
    assert set(scores.trajectory.per_vehicle_rmse_m) == {"auv_1", "auv_2"}
    assert set(scores.alone_rmse_m) == {"auv_1", "auv_2", "auv_3"}


def test_a_vehicle_in_a_wrong_place_counts_as_wrong() -> None:
    truth = missions.truth()
    stamps_ns, poses = truth.trajectories["auv_2"]
    truth.trajectories["auv_2"] = stamps_ns, poses + np.array([5.0, 0.0, 0.0])
    scores = _scores(truth)
    assert scores.trajectory is not None
    assert scores.trajectory.rmse_m > 0.5
    assert scores.alone_rmse_m["auv_2"] < 1e-6


def test_the_headline_names_who_is_not_merged() -> None:
    text = headline(missions.outcome(), _scores(missions.truth()))
    assert "2 of 3 vehicles merged (NOT merged: auv_3)" in text
    assert "0.00 m RMSE" in text
    assert "no truth" in headline(missions.outcome(), _scores(None))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A written report of the hand-made mission."""
    path = tmp_path_factory.mktemp("report")
    write_report(path, missions.outcome(), FACTS, missions.truth())
    return path


def test_the_report_is_one_file_that_says_all(folder: Path) -> None:
    html = (folder / "report.html").read_text()
    assert "A &lt;title&gt;" in html
    assert "the maps share 2% of &lt;their&gt; area" in html
    assert "auv_3 is not in the merged map" in html
    assert html.count("NOT_ENOUGH_OVERLAP") >= 2
    sources = re.findall(r'src="([^"]*)"', html)
    assert sources
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r'(href|src)="http', html)
    _Balance().check(html)


def test_the_numbers_are_there_without_times(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    assert report["num_vehicles_merged"] == 2
    assert report["scores"]["trajectory"]["rmse_m"] < 1e-3
    assert report["seeds"] == {"mission": 3}
    assert "times_s" not in report
    assert sum(report["verdicts"].values()) == report["num_registrations"]


def test_walls_are_lines_that_know_when_they_were_last_seen(folder: Path) -> None:
    features = json.loads((folder / "walls.geojson").read_text())["features"]
    occupancy = read_map(folder / "global_map.yaml")
    assert features
    for feature in features:
        points = np.reshape(feature["geometry"]["coordinates"], (-1, 2))
        cells = occupancy.spec.cells_of(points)
        assert (cells >= 0).all()
        assert (cells < occupancy.spec.shape).all()
        assert feature["properties"]["last_seen_s"] == missions.STAMPS[-1] / 1e9
    dxf = (folder / "walls.dxf").read_text()
    assert dxf.count("POLYLINE") == sum(f["properties"]["kind"] == "wall" for f in features)


def test_pictures_are_not_empty(folder: Path) -> None:
    for name in ("before_after", "trajectory_error", "walls"):
        image = cv2.imread(str(folder / f"{name}.png"))
        assert image is not None
        assert image.shape[1] > 600
        assert image.std() > 10.0


class _Balance(HTMLParser):
    """Every element is closed, in the right order, and no id is used twice."""

    _VOID = frozenset({"meta", "img", "br", "hr", "link", "input", "col", "wbr"})

    def check(self, html: str) -> None:
        self.open: list[str] = []
        self.ids: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []
        assert len(self.ids) == len(set(self.ids))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value for name, value in attrs if name == "id" and value]
        if tag not in self._VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> at line {self.getpos()[0]}"


@pytest.mark.parametrize("num_vehicles", [1, 2, 3])
def test_any_number_of_vehicles_can_be_drawn(num_vehicles: int) -> None:
    vehicles = ("auv_1", "auv_2", "auv_3")[:num_vehicles]
    figure = pictures.before_after(missions.outcome(vehicles), "title")
    # One for each vehicle and one for all.
    assert len(figure.axes) == num_vehicles + 1
    boxes = [axes.get_position() for axes in figure.axes]
    for box in boxes:
        assert 0.0 <= box.x0 < box.x1 <= 1.0
        assert 0.0 <= box.y0 < box.y1 <= 1.0
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a.x0 >= b.x1 or b.x0 >= a.x1 or a.y0 >= b.y1 or b.y0 >= a.y1


def test_long_names_cover_nothing_and_are_not_cut_off() -> None:
    outcome = missions.outcome(("auv_1", "auv_2"))
    names = [v.vehicle_id for v in outcome.vehicles]
    long = {name: 3 * "ground_floor_of_the_old_library/" + name for name in names}

    def renamed(record: SubmapRecord) -> SubmapRecord:
        submap = record.submap
        return replace(record, submap=replace(submap, vehicle_id=long[submap.vehicle_id]))

    outcome = replace(
        outcome,
        vehicles=tuple(replace(v, vehicle_id=long[v.vehicle_id]) for v in outcome.vehicles),
        records=tuple(renamed(record) for record in outcome.records),
    )
    figure = pictures.before_after(outcome, "title")
    width, height = figure.get_size_inches()
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
    data = np.frombuffer(pictures.png_bytes(figure, dpi=100), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    assert picture.shape[0] >= 100 * height - 1
    assert picture.shape[1] >= 100 * width - 1
    # Ink up to the rim would be a text that goes on.
    for rim in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
        assert rim.min() == 255


def test_names_in_pictures_stay_different() -> None:
    names = ["maps_of_the_library/lab@2024", "maps_of_the_library/lab1@2024"]
    short = map_drawing.shortened(names)
    assert len({*short.values()}) == 2
    assert all(len(name) <= 15 for name in short.values())
    assert map_drawing.shortened(["auv_1", "auv_2"]) == {"auv_1": "auv_1", "auv_2": "auv_2"}


def test_a_thin_wall_survives_the_reduction() -> None:
    num_cells = 4000
    values = np.zeros((8, num_cells), dtype=np.int8)
    values[:, 1001] = 100
    occupancy = OccupancyMap(GridSpec(0.05, 8, num_cells), values)
    figure, axes = map_drawing.single_map(occupancy.spec)
    map_drawing.show_map(axes, occupancy)
    shown = np.asarray(axes.images[0].get_array())
    assert shown.shape[1] <= 1600
    assert (shown.sum(axis=2) < 0.2 * 3 * 255).any(axis=1).all()
    assert figure.axes == [axes]


def test_a_rotated_map_is_drawn_where_it_lies() -> None:
    values = np.zeros((10, 30), dtype=np.int8)
    spec = GridSpec(1.0, 10, 30, SE2(5.0, 0.0, np.pi / 2))
    _, axes = map_drawing.single_map(spec)
    map_drawing.show_map(axes, OccupancyMap(spec, values))
    assert axes.get_xlim() == pytest.approx((-5.0, 5.0))
    assert axes.get_ylim() == pytest.approx((0.0, 30.0))


def test_truth_is_read_from_a_folder_or_a_file(tmp_path: Path) -> None:
    write_tum(tmp_path / "auv_1.tum", missions.STAMPS, missions.WAY)
    assert read_truth(tmp_path).map is None
    write_map(tmp_path / "map", missions.room())
    truth = read_truth(tmp_path)
    assert truth.map is not None
    assert list(truth.trajectories) == list(read_truth(tmp_path / "auv_1.tum").trajectories)
    with pytest.raises(DataError, match=r"holds no \.tum file"):
        read_truth(tmp_path.parent)
    with pytest.raises(DataError, match="does not exist"):
        read_truth(tmp_path / "nothing")


def test_the_report_shows_what_each_vehicle_knew_when(tmp_path: Path) -> None:
    def told(other: str) -> dict[str, Any]:
        return {
            "num_submaps_known": 4,
            "num_submaps_known_s": [[5.0, 1], [20.0, 3], [31.5, 4]],
            "joined_s": {other: 40.0},
            "num_vehicles_merged": 2,
            "rmse_m": 0.125,
            "sent": {"coarse": {"packets": 17, "bytes": 1019}},
            "repeated_packets": 3,
        }

    link = {
        "preset": "nano",
        "loss": 0.3,
        "last_ping_s": 30.0,
        "complete_after_last_ping_s": None,
        "is_same_map": True,
        "packets": {"sent": 34, "delivered": 23, "lost": 11},
        "vehicles": {"auv_1": told("auv_2"), "auv_2": told("auv_1")},
    }
    facts = RunFacts("title", [], "demo", {}, {}, {}, link=link)
    write_report(tmp_path, missions.outcome(), facts, missions.truth())
    html = (tmp_path / "report.html").read_text()
    assert "Acoustic link" in html
    assert "coarse 1,019" in html
    assert "byte for byte" in html
    assert json.loads((tmp_path / "report.json").read_text())["link"] == link
    assert cv2.imread(str(tmp_path / "link.png")) is not None
    _Balance().check(html)


def test_what_people_decided_is_listed_with_who_and_when_and_drawn(tmp_path: Path) -> None:
    queue = missions.settled_queue()
    ends = {"source": SubmapId("auv_3", 0, 0), "target": SubmapId("auv_1", 0, 0)}
    motion = missions.T_WORLD_ODOM["auv_1"].inverse() @ missions.T_WORLD_ODOM["auv_3"]
    who = {"who": "Ann <b>", "stamp_ns": 1_700_000_000 * 10**9}
    confirm = Decision(
        DecisionKind.CONFIRM, **ends, T_target_source=motion, sigma_m=0.5, sigma_rad=0.1, **who
    )
    queue.decide(Decision(DecisionKind.FORBID, is_run=True, **ends))
    queue.decide(Decision(DecisionKind.UNDO, undone=1, **who))
    before = outcome_of(queue)
    queue.decide(confirm)
    outcome = outcome_of(queue)
    write_report(tmp_path, outcome, FACTS, None)
    html = (tmp_path / "report.html").read_text()
    assert "Ann &lt;b&gt;" in html
    assert "2023-11-14 22:13:20" in html
    for text in ("FORBID, undone", "all of auv_3, all of auv_1", "decision 1", "undone by 2"):
        assert text in html
    assert "auv_3/0, auv_1/0" in html
    rows = json.loads((tmp_path / "report.json").read_text())["decisions"]
    assert [(row["kind"], row["is_in_force"]) for row in rows] == [
        ("FORBID", False),
        ("UNDO", True),
        ("CONFIRM", True),
    ]
    violet = np.array([0x5B, 0x2A, 0x86])[::-1]

    def drawn(what: Outcome) -> bool:
        data = np.frombuffer(pictures.png_bytes(pictures.before_after(what, "")), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        return bool((np.abs(picture.astype(int) - violet).max(axis=2) < 12).sum() > 50)

    assert not drawn(before)
    assert drawn(outcome)


def test_a_report_without_decisions_does_not_speak_of_them(folder: Path) -> None:
    assert "Decided by people" not in (folder / "report.html").read_text()


def test_matches_are_shown_as_the_view_shows_them(folder: Path) -> None:
    queue = missions.settled_queue()
    showing = QueueSource("", queue).showing()
    looks = dict(outcome_of(queue).looks)
    rows = outcome_of(queue).registrations
    assert rows[min(looks) - 1].is_used
    # The one that holds first, and of the runs that are apart the best guess.
    assert [rows[number - 1].is_used for number in looks] == [True, False, False]
    html = (folder / "report.html").read_text()
    assert "Matches, looked into" in html
    assert html.count(": the best guess, not used") == 2
    for number, look in looks.items():
        png = (folder / f"match_{number}.png").read_bytes()
        assert png == look.picture("agreement", 420)
        assert look.picture("agreement") == showing.pair(number).picture("agreement")
