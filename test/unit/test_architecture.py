"""Imports point one way, wherever in a file they stand."""

import ast
from collections import defaultdict
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NAME = "uw_dslam_ros2"
PACKAGE = ROOT / NAME / NAME

# A room, and the rooms that nothing in it may import. Paths below the package, in dots.
CLOSED = {
    "core": {"io", "sim", "view", "ros", "cli"},
    "io": {"sim", "view", "ros", "cli"},
    "sim": {"view", "ros", "cli"},
    "view": {"sim", "ros", "cli"},
    "ros": {"sim", "cli"},
    "ros.convert": {"ros.plumbing", "ros.mapper", "ros.manager", "ros.nodes"},
    "ros.plumbing": {"ros.nodes", "ros.mapper", "ros.manager"},
    "ros.mapper": {"ros.nodes", "ros.manager"},
    "ros.manager": {"ros.nodes", "ros.mapper"},
    "core.mapping": {"core.merging"},
    "core.merging": {"core.mapping"},
    "core.link": {"core.mapping", "core.merging"},
    "core.registration": {"core.mapping", "core.merging"},
    "core.registration.search": {
        f"core.registration.{room}" for room in ("points", "grids", "baselines")
    },
    "core.registration.points": {f"core.registration.{room}" for room in ("grids", "baselines")},
    "core.registration.grids": {"core.registration.baselines"},
    "core.registration.baselines": {
        f"core.registration.{room}" for room in ("search", "points", "grids")
    },
}

# Places whose own modules and folders are rooms; elsewhere a room is all that lies in a folder.
HOUSES = {"core", "core.registration", "ros"}


def is_in(module, room):
    return module == room or module.startswith(f"{room}.")


def imports(text, module, is_package=False):
    """Full names that `text`, the source of `module`, imports; of ``from a import b`` both."""
    found = set()
    here = module.split(".")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = [node.module] if node.module else []
            if node.level:
                base = here[: len(here) - node.level + is_package] + base
            found |= {".".join([*base, alias.name]) for alias in node.names} | {".".join(base)}
    return found


@cache
def own_imports(file, folder=PACKAGE):
    """Modules and names of our package that a file imports, without the package's name."""
    parts = [NAME, *file.relative_to(folder).with_suffix("").parts]
    is_package = parts[-1] == "__init__"
    names = imports(file.read_text(), ".".join(parts[: -1 if is_package else None]), is_package)
    return {name.removeprefix(f"{NAME}.") for name in names if name.startswith(f"{NAME}.")}


def modules():
    """Each module of the package, without the package's name, and its file."""
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        yield ".".join(part for part in parts if part != "__init__"), file


def test_imports_are_found_wherever_they_stand():
    text = """
import p.a.x, numpy
from p.b import c
from . import d
from ..e import f
def late():
    from .g.h import i
    if True:
        import p.j as k
"""
    found = imports(text, "p.q.r")
    assert found == {
        "p.a.x", "numpy", "p.b", "p.b.c", "p.q", "p.q.d", "p.e", "p.e.f", "p.q.g.h", "p.q.g.h.i",
        "p.j",
    }  # fmt: skip
    assert imports("from .s import t", "p.q", is_package=True) == {"p.q.s", "p.q.s.t"}


@pytest.mark.parametrize("room", CLOSED)
def test_a_room_knows_nothing_of_those_above_it(room):
    inside = [(module, file) for module, file in modules() if is_in(module, room)]
    assert inside, f"there is no {room}"
    for closed in CLOSED[room]:
        assert any(is_in(module, closed) for module, _ in modules()), f"there is no {closed}"
        wrong = {m: n for m, file in inside for n in own_imports(file) if is_in(n, closed)}
        assert wrong == {}


def test_core_knows_no_ros():
    outside = {"rclpy", "uw_dslam_msgs", "sensor_msgs", "nav_msgs", "geometry_msgs", "rosbags"}
    for module, file in modules():
        if is_in(module, "core"):
            assert not {name.split(".")[0] for name in imports(file.read_text(), "")} & outside


def test_rooms_have_no_circle():
    known = {module for module, _ in modules()}

    def room_of(name):
        while name not in known:  # a class or a function
            name = name.rpartition(".")[0]
        parts = name.split(".")
        depth = 1
        while depth < len(parts) and ".".join(parts[:depth]) in HOUSES:
            depth += 1
        return ".".join(parts[:depth])

    arrows = defaultdict(set)
    for module, file in modules():
        if module:
            arrows[room_of(module)] |= {room_of(name) for name in own_imports(file)}
    for room, others in arrows.items():
        others.discard(room)
    assert {"core.se2", "core.merging", "core.registration.search", "ros.nodes"} <= set(arrows)
    TopologicalSorter(arrows).prepare()  # raises CycleError, which names the circle


def test_tests_know_no_command_but_those_of_the_commands():
    """What such a test needs of a command belongs beside the test, or into the room."""
    for file in sorted((ROOT / "test" / "unit").rglob("*.py")):
        if file.relative_to(ROOT / "test" / "unit").parts[0] != "cli":
            wrong = {name for name in own_imports(file, ROOT / "test") if is_in(name, "cli")}
            assert wrong == set(), file.name
