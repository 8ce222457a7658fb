"""``view [FOLDER]``: a saved merge, or the running graph, in the browser."""

from __future__ import annotations

import argparse
import asyncio
import functools
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from uw_dslam_ros2.cli.common import parser_for, run_command
from uw_dslam_ros2.cli.reporting.rewriting import has_report, write_anew
from uw_dslam_ros2.io.sessions.session import load_session, session_of
from uw_dslam_ros2.view.queue_source import QueueSource
from uw_dslam_ros2.view.server import ViewServer

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--ros-args") if "--ros-args" in words else len(words)
    args = _parser().parse_args(words[:cut])
    if args.folder is None:
        return _follow_graph(args, words[cut:])
    return run_command("view", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "view",
        "Show a merge in the browser: the global map, vehicles, submaps, constraints, and each\n"
        "registration with both maps laid on each other. Take what people say of it: withdraw,\n"
        "forbid, confirm, lay by hand, pin, fix, undo; a result's maps and report are then\n"
        "written anew. Without FOLDER it follows the map_queue_manager of the running graph;\n"
        "its parameters may come after --ros-args.",
        "view result",
    )
    parser.add_argument(
        "folder",
        type=Path,
        nargs="?",
        metavar="FOLDER",
        help="result of offline or demo, or a session that map_queue_manager saved",
    )
    parser.add_argument(
        "--address",
        default="127.0.0.1",
        help="where to listen; another than this machine's own (127.0.0.1) asks browsers for a "
        "token",
    )
    parser.add_argument("--port", type=int, default=8080, help="0: any that is free")
    parser.add_argument("--token", default="", help="drawn at random where one is needed")
    return parser


def _follow_graph(args: argparse.Namespace, ros_args: Sequence[str]) -> int:
    """Become the node, which needs ROS; a saved merge does not."""
    settings = [f"{name}:={getattr(args, name)}" for name in ("address", "port")]
    if args.token:
        settings.append(f"token:={args.token}")
    options = [word for setting in settings for word in ("-p", setting)]
    module = "uw_dslam_ros2.ros.nodes.view"
    tail = ros_args[1:] if ros_args else []
    os.execv(sys.executable, [sys.executable, "-m", module, "--ros-args", *options, *tail])


def _run(args: argparse.Namespace) -> int:
    folder = args.folder
    holder = session_of(folder)
    write = functools.partial(write_anew, folder) if has_report(folder) else None
    source = QueueSource(folder.resolve().name, load_session(holder), holder, write)
    server = ViewServer(source, args.address, args.port, args.token)
    try:
        asyncio.run(_serve(server))
    finally:
        source.close()
    return 0


async def _serve(server: ViewServer) -> None:
    done = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, done.set)
    print(f"view: {await server.start()}   (Ctrl+C ends it)", flush=True)
    await done.wait()
    await server.stop()


if __name__ == "__main__":
    sys.exit(main())
