"""What all commands share: how errors are told, progress bars, versions."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from tqdm import tqdm

import uw_dslam_ros2
from uw_dslam_ros2.core.errors import DataError, NothingMappedError, UwDslamError

__all__ = [
    "EXIT_BAD_INPUT",
    "EXIT_NOTHING_MADE",
    "Progress",
    "config_file",
    "parser_for",
    "progress_bar",
    "run_command",
    "versions",
    "warn",
]

EXIT_NOTHING_MADE = 1
"""Exit code where the input is readable, but nothing could be made of it."""
EXIT_BAD_INPUT = 2
"""Exit code for wrong usage, files and settings; argparse uses the same."""
_EXIT_INTERRUPTED = 130
_EXIT_BROKEN_PIPE = 141  # as of programs that the signal ends
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "scikit-learn")


def parser_for(name: str, description: str, example: str) -> argparse.ArgumentParser:
    """Make a parser whose help text ends with an example."""
    return argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=f"Example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def run_command(name: str, command: Callable[[], int]) -> int:
    """Run a command; what a person can mend is told in one line on stderr.

    The exit code is 2 then, or 1 where nothing could be made of good input.
    """
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # Who reads the output has seen enough, as `| head` does; Python would try again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_BROKEN_PIPE
    except UwDslamError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return EXIT_NOTHING_MADE if isinstance(error, NothingMappedError) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return _EXIT_INTERRUPTED


def warn(sentence: str) -> None:
    """Say on stderr what was probably not meant."""
    print(f"warning: {sentence}", file=sys.stderr)


class Progress(Protocol):
    """A bar that is told where it stands."""

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` parts are done."""


@contextmanager
def progress_bar(title: str, unit: str) -> Iterator[Progress]:
    """Show a bar on a terminal; elsewhere nothing."""
    with tqdm(
        desc=title, unit=unit, disable=not sys.stderr.isatty(), leave=False, dynamic_ncols=True
    ) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.n = done
            bar.refresh()

        yield show


def num_processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


def num_workers(num_jobs: int) -> int:
    """Processes for jobs of about the same length.

    Up to two a processor: three jobs on two processors, one each, would take as long as four.
    """
    return max(1, min(num_jobs, 2 * num_processors()))


def versions() -> dict[str, str]:
    """Versions of what computes."""
    found = {"uw_dslam_ros2": uw_dslam_ros2.__version__, "python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            found[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:  # an installed ROS names some differently
            found[library] = "unknown"
    return found


def config_file(name: str) -> Path:
    """Find a settings file of ours: in the checkout, or where colcon installed it."""
    folders = [Path(uw_dslam_ros2.__file__).resolve().parents[2] / "config"]
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(":")
    folders += [Path(prefix) / "share" / "uw_dslam_ros2" / "config" for prefix in prefixes]
    found = [folder / name for folder in folders if (folder / name).is_file()]
    if not found:
        raise DataError(f"the settings file {name} is in none of {', '.join(map(str, folders))}")
    return found[0]
