"""What the README says can be done."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from uw_dslam_ros2.node_names import EXECUTABLES

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


def _executables() -> set[str]:
    """Names that setup.py makes executable, read without running it."""
    tree = ast.parse((ROOT / "uw_dslam_ros2" / "setup.py").read_text())
    values = {
        node.targets[0].id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    return {*EXECUTABLES, *ast.literal_eval(values["COMMANDS"])}


def test_the_python_example_runs_as_it_stands(capsys) -> None:
    (code,) = _blocks("python")
    assert len(code.splitlines()) <= 12
    variables: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), variables)
    result, expected = variables["result"], variables["T_target_source"]
    assert capsys.readouterr().out.startswith("ACCEPTED ")
    distance_m, angle_rad = result.T_target_source.distance_to(expected)
    assert distance_m < 0.015
    assert angle_rad < 0.001


def test_commands_exist() -> None:
    names = _executables()
    assert {"sonar_mapper", "offline"} <= names
    text = "\n".join(_blocks("sh")) + README
    for name in re.findall(r"(?:\./uw run|ros2 run uw_dslam_ros2) ([a-z_]+)", text):
        assert name in names, name
    usage = (ROOT / "uw").read_text()
    for command in re.findall(r"\./uw ([a-z]+)", text):
        assert re.search(rf"^    {command}[ |)]", usage, re.MULTILINE), command
    for file in re.findall(r"ros2 launch uw_dslam_ros2 (\S+)", text):
        assert (ROOT / "uw_dslam_ros2" / "launch" / file).is_file()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_links_lead_somewhere(target: str) -> None:
    assert (ROOT / target).exists()


def test_pictures_are_small() -> None:
    for file in (ROOT / "docs" / "images").iterdir():
        assert file.stat().st_size < 300_000, file.name


def test_dependencies_are_justified() -> None:
    reasons = (ROOT / "docs" / "dependencies.md").read_text().lower()
    lines = (ROOT / "requirements" / "python.in").read_text().splitlines()
    packages = [re.split(r"[<=>;\s#]", line)[0].lower() for line in lines if line.strip()]
    for package in filter(None, packages):
        if not package.startswith("colcon-"):
            assert package in reasons, package
