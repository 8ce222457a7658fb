"""The command ``study NAME``: the paper's experiments and others, with pictures and tables.

A study is a module in ``cli/studies`` whose docstring's first line is its help text, with
``add_arguments(parser)`` and ``run(args) -> int``. Modules whose name begins with ``_`` are
shared helpers.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path

from uw_dslam_ros2.cli import studies
from uw_dslam_ros2.core.errors import UwDslamError

__all__ = ["build_parser", "main", "study_names"]


def study_names() -> list[str]:
    """Names of all studies, sorted."""
    found = (module.name for module in pkgutil.iter_modules(studies.__path__))
    return sorted(name for name in found if not name.startswith("_"))


def build_parser() -> argparse.ArgumentParser:
    """Command line with one subcommand for each study."""
    parser = argparse.ArgumentParser(prog="study", description="Run one of the experiments.")
    subparsers = parser.add_subparsers(dest="name", metavar="NAME", required=True)
    for name in study_names():
        module = importlib.import_module(f"{studies.__name__}.{name}")
        text = (module.__doc__ or name).strip()
        study = subparsers.add_parser(
            name.replace("_", "-"),
            help=text.split("\n")[0],
            description=text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        study.add_argument(
            "--out",
            type=Path,
            default=Path("study") / name,
            metavar="DIR",
            help="folder for pictures and CSV (made if missing; default: %(default)s)",
        )
        module.add_arguments(study)
        study.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a study; returns the exit code."""
    args = build_parser().parse_args(argv)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        return int(args.run(args))
    except UwDslamError as error:
        print(f"study {args.name}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"study {args.name}: cannot write to {args.out}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"study {args.name}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
