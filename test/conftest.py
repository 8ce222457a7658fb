"""Fixtures that every test may use."""

import contextlib
import itertools
import os
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# A busy machine is no fault of the code: hypothesis must not fail a test for its wall-clock time.
settings.register_profile("uw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("uw")

TESTS = Path(__file__).parent
DEADLINE_S = 30.0
# Each test takes the next, for in one that was just left something may still be heard.
_domains = itertools.cycle(range(1, 101))


def pytest_configure():
    # Where ROS is promised, node tests must not be skipped for want of it.
    if os.environ.get("UW_REQUIRE_ROS") == "1":
        import rclpy  # noqa: F401


def pytest_collection_modifyitems(items):
    """Tell pytest-xdist what stays together.

    Tests of a file share fixtures. Those with nodes measure times, so no two of them run at once.
    Where kernels are compiled with checks, tests of a folder share them, and compile them once.
    """
    is_checked = os.environ.get("NUMBA_BOUNDSCHECK", "0") != "0"
    for item in items:
        file = item.path.relative_to(TESTS)
        group = str(file.parent if is_checked else file)
        if file.parts[0] in ("node", "system"):
            group = "nodes"
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture
def rng():
    """A seeded generator, the same in every test."""
    return np.random.default_rng(2023)


@pytest.fixture
def ros_domain_id():
    """A DDS domain that no other test on this machine uses while this one runs."""
    for domain_id in _domains:
        claim = socket.socket()
        try:
            claim.bind(("127.0.0.1", 21000 + domain_id))
        except OSError:
            claim.close()
            continue
        with claim:
            yield domain_id
        return


@pytest.fixture
def ros_context(ros_domain_id, monkeypatch):
    """A context of its own, on a domain of its own."""
    rclpy = pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_PYTHON_CHECK_FIELDS", "1")
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain_id)
    yield context
    context.try_shutdown()


@pytest.fixture
def spinning(ros_context):
    """``with spinning(node, probe) as until: until(lambda: got)``; destroys the nodes at the end.

    `until` spins until its argument is true, and fails at a deadline.
    """
    from rclpy.executors import MultiThreadedExecutor

    @contextlib.contextmanager
    def spin(*nodes):
        num_threads = 2 + sum(getattr(node, "num_threads", 1) for node in nodes)
        executor = MultiThreadedExecutor(num_threads, context=ros_context)
        for node in nodes:
            executor.add_node(node)

        def until(is_true, what="", deadline_s=DEADLINE_S):
            end_s = time.monotonic() + deadline_s
            while not is_true():
                assert time.monotonic() < end_s, f"not within {deadline_s} s: {what or is_true}"
                executor.spin_once(timeout_sec=0.02)

        try:
            yield until
        finally:
            for node in nodes:
                node.destroy_node()
            executor.shutdown(timeout_sec=5.0)

    return spin
