"""Merging map files: with planted answers what is written and told, and once in earnest."""

from __future__ import annotations

import csv
import dataclasses
import json
import math

import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.cli import merge, register
from uw_dslam_ros2.cli.running import map_merging
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MatchRequest
from uw_dslam_ros2.core.registration import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import read_map, write_map
from uw_dslam_ros2.io.maps.provenance import read_provenance

# Where the maps' frames lie in the world: far away and turned, as UTM and other programs have it.
T_WORLD_MAP = {
    "a": SE2(3.0, -2.0, 0.4),
    "b": SE2(-500_000.0, 80_000.0, -1.1),
    "c": SE2(60.0, 0.0, 3.0),
}


# An answer with all its numbers; who asks does not matter.
TEMPLATE = missions.answer(
    MatchRequest(
        0,
        missions.room(),
        missions.room(),
        None,
        (),
        (),
        ("auv_2", 0, 0),
        ("auv_1", 0, 0),
        (b"", b"", ()),
    )
)


def place(name: str) -> OccupancyMap:
    """The room of `missions` as a map whose frame lies anywhere, in a wide unknown margin."""
    room = missions.room()
    values = np.full((90, 100), -1, np.int8)
    values[20:80, 30:90] = room.values
    margin = SE2(-30 * 0.2, -20 * 0.2)
    T_map_grid = T_WORLD_MAP[name].inverse() @ room.spec.T_frame_grid @ margin
    return OccupancyMap(GridSpec(0.2, 90, 100, T_map_grid), values)


def finer(occupancy: OccupancyMap, factor: int) -> OccupancyMap:
    spec = occupancy.spec
    values = occupancy.values.repeat(factor, axis=0).repeat(factor, axis=1)
    return OccupancyMap(
        GridSpec(spec.resolution_m / factor, *values.shape, spec.T_frame_grid), values
    )


class Planted:
    """Tells the truth about all maps that are named, and refuses the others."""

    def __init__(self, maps, known) -> None:
        self._maps, self._known = {one.name: one for one in maps}, known

    def __call__(self, queue) -> None:
        while requests := queue.next_requests(1):
            (request,) = requests
            names = request.source_reference[0], request.target_reference[0]
            poses = [T_WORLD_MAP[name] @ self._maps[name].T_map_submap for name in names]
            is_known = set(names) <= set(self._known)
            answer = dataclasses.replace(
                TEMPLATE,
                verdict=Verdict.ACCEPTED if is_known else Verdict.AMBIGUOUS,
                reason="as planted" if is_known else "it fits, thrice",
                T_target_source=poses[1].inverse() @ poses[0],
                probability=0.99 if is_known else 0.1,
            )
            queue.add_result(request.request_id, answer)


@pytest.fixture
def files(tmp_path):
    """Three map files of one room, the second one finer and negated."""
    for name in T_WORLD_MAP:
        write_map(tmp_path / name, finer(place(name), 4) if name == "b" else place(name))
    return {name: tmp_path / f"{name}.yaml" for name in T_WORLD_MAP}


@pytest.fixture
def plant(monkeypatch):
    """Let the command have planted answers."""

    def set_up(*known: str) -> None:
        def settle(queue, _config, _progress):
            Planted(settle.maps, known)(queue)

        def merge_maps(maps, *args, **kwargs):
            settle.maps = maps
            return map_merging.merge_maps(maps, *args, **kwargs)

        monkeypatch.setattr(map_merging, "settle", settle)
        monkeypatch.setattr(merge, "merge_maps", merge_maps)

    return set_up


def run(files, out, *extra: str) -> int:
    return merge.main([*(str(file) for file in files.values()), "--out", str(out), *extra])


def table(out) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "verdicts.csv").read_text().splitlines()))


def test_all_maps_are_drawn_into_the_frame_of_the_first(files, plant, tmp_path, capsys) -> None:
    plant("a", "b", "c")
    out = tmp_path / "out"
    assert run(files, out) == 0
    first, merged = read_map(files["a"]), read_map(out / "merged.yaml")
    assert merged.spec.resolution_m == pytest.approx(0.05)  # the finest, and a whole share of a's
    assert merged.spec.T_frame_grid.yaw == pytest.approx(first.spec.T_frame_grid.yaw)
    cells = np.argwhere(merged.known)
    own = first.spec.cells_of(merged.spec.centers_of(cells))
    expected, found = first.values[own[:, 0], own[:, 1]], merged.values[cells[:, 0], cells[:, 1]]
    # Maps that lie anywhere are drawn to half of one of their cells.
    assert np.mean(expected == found) > 0.9
    assert np.mean(found[expected == 100] == 100) > 0.95
    made = json.loads((out / "merge.json").read_text())
    assert (made["joined"], made["apart"], made["frame"]) == (["a", "b", "c"], [], "a")
    for entry in made["maps"]:
        motion = T_WORLD_MAP["a"].inverse() @ T_WORLD_MAP[entry["name"]]
        # Half a million metres away, a billionth of a turn is half a millimetre.
        np.testing.assert_allclose(entry["T_group_map"], motion.as_array(), atol=2e-2)
    for row in table(out):
        assert (row["verdict"], row["is_used"]) == ("ACCEPTED", "True")
        motion = T_WORLD_MAP[row["target"]].inverse() @ T_WORLD_MAP[row["source"]]
        assert float(row["x"]) == pytest.approx(motion.x, abs=1e-6)
        assert float(row["y"]) == pytest.approx(motion.y, abs=1e-6)
        assert float(row["sigma_m"]) == pytest.approx(0.01)
    provenance = read_provenance(out / "merged_provenance.npz")
    assert provenance.spec == merged.spec
    assert (("a", 0, 0), ("b", 0, 0), ("c", 0, 0)) in provenance.contributors
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "joined: a, b, c: " in said
    assert "apart" not in said


def test_what_cannot_be_joined_stays_out_and_is_named(files, plant, tmp_path, capsys) -> None:
    plant("b", "c")
    assert run(files, tmp_path / "out") == merge.EXIT_APART
    made = json.loads((tmp_path / "out" / "merge.json").read_text())
    assert (made["joined"], made["apart"], made["frame"]) == (["b", "c"], ["a"], "b")
    said = capsys.readouterr().out
    assert "apart: a: it fits, thrice" in said
    assert {row["verdict"] for row in table(tmp_path / "out")} == {"ACCEPTED", "AMBIGUOUS"}


def test_one_map_alone_is_no_merged_map(files, plant, tmp_path, capsys) -> None:
    """Nor is the one of an earlier run."""
    out = tmp_path / "out"
    plant("a", "b", "c")
    assert run(files, out) == 0
    plant()
    assert run(files, out, "--json") == merge.EXIT_APART
    assert not [path.name for path in out.iterdir() if path.name.startswith("merged")]
    assert {path.name for path in out.iterdir()} == {"merge.json", "picture.png", "verdicts.csv"}
    text = capsys.readouterr().out
    made = json.loads(text[text.index("\n{") :])
    assert (made["joined"], made["frame"], made["apart"]) == ([], None, ["a", "b", "c"])


def test_the_same_maps_give_the_same_bytes(files, plant, tmp_path) -> None:
    plant("a", "c")
    for name in ("one", "two"):
        run(files, tmp_path / name)
    contents = [
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("one", "two")
    ]
    assert contents[0] == contents[1]
    assert len(contents[0]) == 8


def test_cells_may_be_chosen_and_are_bounded(files, plant, tmp_path, capsys) -> None:
    plant("a", "b", "c")
    assert run(files, tmp_path / "out", "--resolution", "0.4") == 0
    assert read_map(tmp_path / "out" / "merged.yaml").spec.resolution_m == 0.4
    assert run(files, tmp_path / "huge", "--resolution", "0.0001") == merge.EXIT_UNREADABLE
    said = capsys.readouterr().err
    assert "expected at most 20000 a side: choose larger cells by --resolution" in said
    assert not (tmp_path / "huge").exists()


def test_a_map_that_knows_nothing_stays_apart_with_its_reason(tmp_path, capsys) -> None:
    nothing = OccupancyMap(GridSpec(0.05, 40, 50), np.full((40, 50), -1, np.int8))
    for name in ("n", "m"):
        write_map(tmp_path / name, nothing)
    files = {name: tmp_path / f"{name}.yaml" for name in ("n", "m")}
    assert run(files, tmp_path / "out") == merge.EXIT_APART
    assert "apart: n: the map knows nothing" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace("resolution: 0.2", "resolution: wide"), "resolution is 'wide'"),
        (lambda text: text.replace("a.pgm", "gone.pgm"), "gone.pgm: No such file"),
        (lambda text: text.replace("image", "picture"), "image is missing"),
    ],
)
def test_bad_files_are_one_line_and_exit_code_1(change, said, files, tmp_path, capsys) -> None:
    files["a"].write_text(change(files["a"].read_text()))
    assert run(files, tmp_path / "out") == merge.EXIT_UNREADABLE == 1
    error = capsys.readouterr().err
    assert error.startswith("merge: error: ")
    assert error.count("\n") == 1
    assert said in error
    assert not (tmp_path / "out").exists()


def test_a_map_given_twice_is_refused(files, tmp_path, capsys) -> None:
    assert run({"a": files["a"], "b": files["a"]}, tmp_path / "out") == 1
    assert "is given twice" in capsys.readouterr().err


@pytest.mark.parametrize("extra", [[], ["--resolution", "0"], ["--resolution", "nan"]])
def test_wrong_usage_is_exit_code_2(extra, files, tmp_path) -> None:
    maps = {"a": files["a"]} if not extra else files
    with pytest.raises(SystemExit) as caught:
        run(maps, tmp_path / "out", *extra)
    assert caught.value.code == 2


def test_names_are_told_apart_by_their_folders(tmp_path) -> None:
    paths = [tmp_path / "x" / "map.yaml", tmp_path / "y" / "map.yaml", tmp_path / "hall.yaml"]
    for path in paths:
        write_map(path.with_suffix(""), place("a"))
    assert [one.name for one in merge.read_maps(paths)] == ["x/map", "y/map", "hall"]


def test_unknown_that_reads_as_free_is_told(files, tmp_path, plant, capsys) -> None:
    plant()
    files["a"].write_text(files["a"].read_text().replace("0.196", "0.25"))
    run(files, tmp_path / "out")
    assert "warning: " in (said := capsys.readouterr().err)
    assert "free_thresh is 0.25" in said


def test_two_parts_of_a_place_are_merged_in_earnest(tmp_path, rng) -> None:
    """Cut from one plan at different cells and angles; the answer is known."""
    plan = np.zeros((300, 400), np.int8)
    for _ in range(26):
        row, col = rng.integers(5, 250), rng.integers(5, 330)
        height, width = rng.integers(6, 60, size=2)
        plan[row : row + height, col : col + 3] = 100
        plan[row : row + 3, col : col + width] = 100
    whole = OccupancyMap(GridSpec(0.05, 300, 400), plan)
    left = OccupancyMap(GridSpec(0.05, 300, 300, SE2(7.0, 1.0, 0.5)), plan[:, :300].copy())
    right = finer(OccupancyMap(GridSpec(0.05, 300, 320, SE2(-3.0, 2.0)), plan[:, 80:].copy()), 2)
    write_map(tmp_path / "left", left)
    write_map(tmp_path / "right", right)
    files = {name: tmp_path / f"{name}.yaml" for name in ("left", "right")}
    out = tmp_path / "out"
    assert run(files, out) == 0
    made = json.loads((out / "merge.json").read_text())
    T_left_right = SE2(*made["maps"][1]["T_group_map"])
    T_whole_right = SE2(4.0, 0.0) @ right.spec.T_frame_grid.inverse()
    expected = left.spec.T_frame_grid @ T_whole_right
    distance_m, angle_rad = T_left_right.distance_to(expected)
    assert distance_m < 0.05
    assert math.degrees(angle_rad) < 0.3
    merged = read_map(out / "merged.yaml")
    assert merged.spec.resolution_m == 0.025
    cells = np.argwhere(merged.known)
    points = left.spec.T_frame_grid.inverse().apply(merged.spec.centers_of(cells))
    own = whole.spec.cells_of(points)
    is_inside = whole.spec.contains(own)
    own, cells = own[is_inside], cells[is_inside]
    same = plan[own[:, 0], own[:, 1]] == merged.values[cells[:, 0], cells[:, 1]]
    assert same.mean() > 0.97
    assert own[:, 1].min() == 0
    assert own[:, 1].max() == 399
    # The same two through `register`, with its own answer.
    arguments = [str(file) for file in files.values()]
    assert register.main([*arguments, "--merge", str(tmp_path / "two")]) == 0
    again = json.loads((tmp_path / "two" / "merge.json").read_text())
    assert (again["joined"], again["frame"]) == (["right", "left"], "right")
    T_right_left = SE2(*again["maps"][1]["T_group_map"])
    distance_m, angle_rad = T_right_left.distance_to(expected.inverse())
    assert distance_m < 0.05
    assert math.degrees(angle_rad) < 0.3
