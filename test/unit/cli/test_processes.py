"""Processes of the demo: they end with their parent, and a failure is explained."""

from __future__ import annotations

import os
import signal
import socket
import textwrap
import time
from pathlib import Path

import pytest

from uw_dslam_ros2.cli.running import processes
from uw_dslam_ros2.cli.running.processes import Child, ChildError, Children, free_domain

MODULE = """
import pathlib, signal, sys, time

def main():
    print("begun", flush=True)
    kind, marks = sys.argv[1], pathlib.Path(sys.argv[2])
    if kind == "fails":
        print("the disk is on fire")
        return 3
    if kind == "ends":
        return 0
    if kind == "stubborn":
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    (marks / kind).write_text("")
    try:
        time.sleep(600)
    except KeyboardInterrupt:
        (marks / "clean").write_text("")
        return 0
"""


@pytest.fixture
def children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Children:
    """A group whose processes can import the module above."""
    (tmp_path / "child_module.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.setattr(processes, "_PATIENCE_S", 2.0)
    return Children({**os.environ, "PYTHONPATH": str(tmp_path)}, tmp_path / "logs")


def _wait_for(path: Path) -> None:
    end_s = time.monotonic() + 30.0
    while not path.exists():
        assert time.monotonic() < end_s, f"{path} did not appear"
        time.sleep(0.02)


def _wait_for_end(child: Child) -> None:
    end_s = time.monotonic() + 30.0
    while child.poll() is None:
        assert time.monotonic() < end_s, f"{child.name} did not end"
        time.sleep(0.02)


def test_leaving_the_block_ends_the_processes_cleanly(children, tmp_path) -> None:
    with children:
        child = children.start("node", "child_module", ["waits", str(tmp_path)])
        _wait_for(tmp_path / "waits")
        children.check()
        assert child.poll() is None
    assert child.poll() == 0
    assert (tmp_path / "clean").exists()


def test_a_stubborn_process_is_killed(children, tmp_path) -> None:
    with children:
        child = children.start("node", "child_module", ["stubborn", str(tmp_path)])
        _wait_for(tmp_path / "stubborn")
    assert child.poll() == -9


def test_children_hear_an_interrupt_that_a_background_job_ignores(children, tmp_path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with children:
            child = children.start("node", "child_module", ["waits", str(tmp_path)])
            _wait_for(tmp_path / "waits")
    finally:
        signal.signal(signal.SIGINT, before)
    assert child.poll() == 0
    assert (tmp_path / "clean").exists()


def test_a_failure_ends_all_and_shows_the_log(children, tmp_path) -> None:
    other = None
    with pytest.raises(ChildError) as caught, children:  # noqa: PT012 (the block is the test)
        other = children.start("other", "child_module", ["waits", str(tmp_path)])
        _wait_for(tmp_path / "waits")
        failing = children.start("failing", "child_module", ["fails", str(tmp_path)])
        _wait_for_end(failing)
        children.check()
    text = str(caught.value)
    assert "failing ended with code 3" in text
    assert "the disk is on fire" in text
    assert str(tmp_path / "logs" / "failing.log") in text
    assert other is not None
    assert other.poll() == 0


def test_a_process_that_may_end_may_end_well(children, tmp_path) -> None:
    with children:
        player = children.start("player", "child_module", ["ends", str(tmp_path)], may_end=True)
        _wait_for_end(player)
        children.check()
        broken = children.start("broken", "child_module", ["fails", str(tmp_path)], may_end=True)
        _wait_for_end(broken)
        with pytest.raises(ChildError, match="broken ended with code 3"):
            children.check()


def test_domains_in_use_are_not_given_twice() -> None:
    first, claim = free_domain()
    with claim:
        assert 1 <= first <= 100
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(("127.0.0.1", 21000 + first))
