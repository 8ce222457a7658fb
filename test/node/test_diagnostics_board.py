"""What a view shows of the nodes: the newest of each, and how fast links send."""

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from uw_dslam_ros2.ros.manager.diagnostics_board import DiagnosticsBoard

pytestmark = pytest.mark.ros


def array(name, level=DiagnosticStatus.OK, message="", **values):
    pairs = [KeyValue(key=key.replace("_", " "), value=str(v)) for key, v in values.items()]
    return DiagnosticArray(
        status=[DiagnosticStatus(name=name, level=level, message=message, values=pairs)]
    )


def test_the_newest_status_of_each_node_is_shown():
    board = DiagnosticsBoard()
    board.note(array("b", DiagnosticStatus.WARN, "silent"), 1.0)
    board.note(array("a", values="3"), 2.0)
    assert board.troubles() == ["b: silent"]
    assert [(r["name"], r["level"], r["age_s"]) for r in board.rows(4.0)] == [
        ("a", "ok", 2.0),
        ("b", "warning", 3.0),
    ]
    board.note(array("b"), 5.0)
    assert board.troubles() == []


def test_bytes_on_the_link_are_summed_and_become_a_rate():
    board = DiagnosticsBoard()
    for now_s, outlines, cells in ((10.0, 100, 0), (12.0, 150, 75), (13.0, 5, 0)):
        board.note(array("link", sent_bytes_outline=outlines, sent_bytes_cells=cells), now_s)
        (row,) = board.rows(now_s)
        assert row["sent_bytes"] == outlines + cells
        # After a restart it counts from nothing again.
        assert row["bits_per_s"] == {10.0: None, 12.0: 8.0 * 125 / 2.0, 13.0: None}[now_s]


def test_names_without_end_do_not_fill_the_memory():
    board = DiagnosticsBoard()
    for number in range(600):
        board.note(array(f"node {number:03d}"), float(number))
    names = [row["name"] for row in board.rows(600.0)]
    assert len(names) == 500
    assert "node 599" in names
    assert "node 000" not in names
