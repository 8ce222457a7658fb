"""The ROS package stands alone: its folder holds what is installed, and names what it needs."""

import ast
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "uw_dslam_ros2"
KEYS = {
    "PIL": "python3-pil",
    "aiohttp": "python3-aiohttp",
    "cv2": "python3-opencv",
    "cycler": "python3-matplotlib",
    "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "mpl_toolkits": "python3-matplotlib",
    "networkx": "python3-networkx",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "skimage": "python3-skimage",
    "sklearn": "python3-sklearn",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}
"""Key of rosdep by module; other modules are ROS packages of their own name."""
WITHOUT_KEY = {"rosbags", "apsw", "backports", "optional"}
"""Only from PyPI, and what comes with it."""


@pytest.fixture(scope="module")
def manifest():
    return ET.parse(PACKAGE / "package.xml").getroot()


def imported():
    """Top-level modules that the package and its launch files import, with a file of each."""
    found = {}
    files = [*(PACKAGE / "uw_dslam_ros2").rglob("*.py"), *(PACKAGE / "launch").glob("*.py")]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names = [node.module]
            for name in names:
                found.setdefault(name.split(".")[0], file.relative_to(ROOT))
    return found


def test_everything_imported_is_declared(manifest):
    declared = {element.text for element in manifest if element.tag.endswith("depend")}
    own = {"uw_dslam_ros2", *sys.stdlib_module_names, *WITHOUT_KEY}
    needed = {KEYS.get(name, name): file for name, file in imported().items() if name not in own}
    assert {key: str(file) for key, file in needed.items() if key not in declared} == {}


def test_every_package_that_a_launch_file_starts_is_declared(manifest):
    declared = {element.text for element in manifest if element.tag == "exec_depend"}
    started = {"uw_dslam_ros2"}
    for file in (PACKAGE / "launch").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            is_package = isinstance(node, ast.keyword) and node.arg == "package"
            if is_package and isinstance(node.value, ast.Constant):
                started.add(node.value.value)
    started.remove("uw_dslam_ros2")
    assert started == {"rviz2", "diagnostic_aggregator"}
    assert started <= declared


def test_the_package_says_who_made_it_and_under_what_terms(manifest):
    assert {"name", "version", "description", "maintainer", "author", "license"} <= {
        element.tag for element in manifest
    }
    assert any(element.tag == "test_depend" for element in manifest)
    names = [element.text for element in manifest if element.tag.endswith("depend")]
    assert len(set(names)) == len(names)


def test_the_folder_alone_installs_its_launch_files_and_settings(tmp_path):
    folder = tmp_path / "alone"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    code = (
        "import json, setuptools; from distutils.core import run_setup; "
        "made = run_setup('setup.py', stop_after='init'); print(json.dumps(made.data_files))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True
    )
    files = {
        Path(name).name for _, names in json.loads(done.stdout.splitlines()[-1]) for name in names
    }
    assert {"package.xml", "vehicles.launch.py", "aggregator.yaml", "uw_dslam.rviz"} <= files
    assert {path.name for path in (ROOT / "config").glob("*.yaml")} <= files
    assert "sonar_mapper.yaml" in files


def test_colcon_finds_the_tests_of_the_checkout():
    """It runs pytest in the package's folder, where a part of them stands for all."""
    text = (PACKAGE / "setup.py").read_text()
    assert '"test": ["pytest"' in text, "colcon takes pytest where the package asks for it"
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q"]
    done = subprocess.run(
        [*command, "-o", "testpaths=../test/unit/core"],
        cwd=PACKAGE,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "test_run_names.py" in done.stdout
    assert "testpaths = ../test/unit\n" in (PACKAGE / "setup.cfg").read_text()


PACKAGES = PACKAGE, ROOT / "uw_dslam_msgs"


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_both_packages_are_released_together(folder):
    root = ET.parse(folder / "package.xml").getroot()
    assert root.findtext("name") == folder.name
    version = root.findtext("version")
    assert f'version="{version}"' in (PACKAGE / "setup.py").read_text()
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert {"author", "license", "maintainer"} <= {element.tag for element in root}
    assert f"Changelog for package {folder.name}\n" in (folder / "CHANGELOG.rst").read_text()


@pytest.mark.parametrize(
    ("folder", "prefix", "names"),
    [
        (PACKAGES[0], "ament_", "copyright flake8 mypy pep257 xmllint"),
        (
            PACKAGES[1],
            "ament_cmake_",
            "copyright cppcheck cpplint flake8 lint_cmake pep257 uncrustify xmllint",
        ),
    ],
    ids=["uw_dslam_ros2", "uw_dslam_msgs"],
)
def test_each_lint_of_ament_is_wired_or_switched_off_by_name(folder, prefix, names):
    text = (folder / "package.xml").read_text()
    assert [name for name in names.split() if prefix + name not in text] == []


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_the_release_tools_changelog_has_the_versions_of_the_changelog(folder):
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)
    text = (folder / "CHANGELOG.rst").read_text()
    told = re.findall(r"^(Forthcoming|\d+\.\d+\.\d+)(?: \(.*\))?\n-+$", text, re.M)
    assert told == ["Forthcoming" if name == "Unreleased" else name for name in versions]
