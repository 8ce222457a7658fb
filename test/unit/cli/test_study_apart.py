"""The study of maps built apart, on a few of them."""

import csv

from uw_dslam_ros2.cli.study import main


def test_apart_registers_a_few_pairs_and_keeps_the_maps(tmp_path, capsys):
    cache = tmp_path / "maps"
    arguments = ["--places", "2", "--vehicles", "2", "--different", "2", "--cache", str(cache)]
    assert main(["apart", "--out", str(tmp_path / "a"), *arguments]) == 0
    with (tmp_path / "a" / "apart.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["group"] == "different" for row in rows) == 2
    assert all(row["matching"] == "False" for row in rows if row["group"] == "different")
    assert (tmp_path / "a" / "apart.png").read_bytes()[:4] == b"\x89PNG"
    text = capsys.readouterr().out
    assert "| different" in text
    assert "4 maps of 2 places" in text
    kept = {path: path.stat().st_mtime_ns for path in cache.rglob("*.npz")}
    assert len(kept) == 4
    assert main(["apart", "--out", str(tmp_path / "b"), *arguments]) == 0
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.npz")} == kept
    with (tmp_path / "b" / "apart.csv").open() as file:
        again = list(csv.DictReader(file))
    assert [{**r, "seconds": ""} for r in rows] == [{**r, "seconds": ""} for r in again]
