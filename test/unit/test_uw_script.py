"""What ./uw says, and the small parts of it that can be tried without setting anything up."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# What the script calls before it has an environment of its own.
TOOLS = (
    *("bash", "basename", "cat", "cksum", "cut", "dirname", "find", "flock", "grep", "head"),
    *("ls", "mkdir", "mv", "nproc", "pwd", "realpath", "rm", "sed", "sha256sum", "sort"),
    *("tail", "tr", "uname", "xargs"),
)
Uw = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout in a path with a space, as far as the script looks at one."""
    folder = tmp_path / "a check out"
    folder.mkdir()
    shutil.copy(ROOT / "uw", folder)
    shutil.copytree(ROOT / "requirements", folder / "requirements")
    shutil.copytree(ROOT / "uw_dslam_msgs", folder / "uw_dslam_msgs")
    for name in ("core", "sim"):
        (folder / "uw_dslam_ros2" / "uw_dslam_ros2" / name).mkdir(parents=True)
    for name in ("launch", "rviz"):
        (folder / "uw_dslam_ros2" / name).mkdir()
    for name in ("setup.py", "setup.cfg", "package.xml"):
        shutil.copy(ROOT / "uw_dslam_ros2" / name, folder / "uw_dslam_ros2")
    shutil.copytree(ROOT / "uw_dslam_ros2" / "config", folder / "uw_dslam_ros2" / "config")
    return folder


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    """A PATH with ordinary tools but no compiler and no Python."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        found = shutil.which(tool)
        if found:
            (folder / tool).symlink_to(found)
    return folder


@pytest.fixture
def uw(checkout: Path, tools: Path) -> Uw:
    """Call the copied script with that PATH; keyword arguments are environment variables."""

    def call(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(tools / "bash"), str(checkout / "uw"), *arguments],
            env={
                "PATH": str(tools),
                "HOME": str(checkout.parent),
                "UW_ROS_ROOT": str(checkout / "no_ros"),
                **environment,
            },
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )

    return call


def _in_script(checkout: Path, commands: str) -> subprocess.CompletedProcess[str]:
    """Run commands with the script's functions defined."""
    return subprocess.run(
        ["bash", "-c", f"source ./uw help >/dev/null\n{commands}"],
        cwd=checkout,
        env={**os.environ, "UW_ROS_ROOT": str(checkout / "no_ros")},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def _pretend_compiler(tools: Path) -> None:
    (tools / "c++").symlink_to(tools / "cat")


def test_help_names_every_command(uw: Uw) -> None:
    done = uw("help")
    assert done.returncode == 0
    for command in ("demo", "test", "lint", "run NAME", "python", "shell", "setup", "clean"):
        assert f"\n  {command} " in done.stdout, command
    assert uw().stdout == done.stdout


def test_an_unknown_command_is_named(uw: Uw) -> None:
    done = uw("dmeo")
    assert done.returncode != 0
    assert "unknown command 'dmeo'" in done.stderr


def test_run_needs_a_name(uw: Uw) -> None:
    done = uw("run")
    assert done.returncode != 0
    assert "needs the name of an executable" in done.stderr


def test_a_missing_compiler_is_told(uw: Uw) -> None:
    done = uw("setup")
    assert done.returncode == 1
    assert "no C++ compiler" in done.stderr
    assert "apt install g++" in done.stderr


def test_a_missing_python_is_told_in_a_sentence(uw: Uw, tools: Path) -> None:
    if (
        list(Path("/opt").glob("python*/bin/python3.12"))
        or Path("/usr/local/bin/python3.12").exists()
    ):
        pytest.skip("this machine has a Python 3.12 in a folder that is always looked into")
    _pretend_compiler(tools)
    done = uw("setup")
    assert done.returncode == 1
    assert "Python 3.12 not found" in done.stderr
    assert "UW_PYTHON" in done.stderr
    assert "Traceback" not in done.stderr


def test_another_python_is_refused(uw: Uw, tools: Path) -> None:
    _pretend_compiler(tools)
    done = uw("setup", UW_PYTHON="/bin/false")
    assert done.returncode == 1
    assert "UW_PYTHON is /bin/false, which is not a working Python 3.12" in done.stderr


def test_a_failed_step_shows_its_log_and_is_done_again(checkout: Path) -> None:
    done = _in_script(checkout, "logged download bash -c 'echo the net is down; exit 4'")
    assert done.returncode == 1
    assert "the net is down" in done.stderr
    assert "step 'download' failed" in done.stderr
    assert str(checkout / ".uw" / "log" / "download.log") in done.stderr


def test_a_stamp_holds_for_its_key_alone(checkout: Path) -> None:
    done = _in_script(
        checkout,
        "stamp a 'x y' && echo early; set_stamp a 'x y'; stamp a 'x y' && echo same; "
        "stamp a 'x z' || echo other",
    )
    assert done.stdout.split() == ["same", "other"]


def test_the_environment_file_survives_a_space_in_the_path(checkout: Path) -> None:
    done = _in_script(checkout, 'mkdir -p "$STATE"; UW_CALLER_PATH=$PATH write_environment')
    assert done.returncode == 0, done.stderr
    show = 'source .uw/env.sh; printf "%s\\n" "$PYTHONPATH" "$PATH" "$NUMBA_CACHE_DIR"'
    lines = subprocess.run(
        ["bash", "-c", show],
        cwd=checkout,
        env={"PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    assert lines[0].split(":")[0] == str(checkout / "uw_dslam_ros2")
    # The caller's own PATH is kept, at the end.
    assert lines[1] == f"{checkout}/.uw/venv/bin:/usr/bin:/bin"
    assert lines[2] == str(checkout / ".uw" / "numba")


def test_the_set_up_key_changes_with_a_message(checkout: Path) -> None:
    before = _in_script(checkout, "hash_of uw_dslam_msgs").stdout
    (checkout / "uw_dslam_msgs" / "msg" / "New.msg").write_text("float64 x\n")
    after = _in_script(checkout, "hash_of uw_dslam_msgs").stdout
    assert before.strip()
    assert after.strip()
    assert before != after


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_shellcheck_finds_nothing() -> None:
    done = subprocess.run(
        ["shellcheck", str(ROOT / "uw")], capture_output=True, text=True, check=False
    )
    assert done.stdout == ""
