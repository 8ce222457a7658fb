"""What a step of a command took from the system is given back after it."""

import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="its malloc is meant")

_START = """
import resource
import numpy as np
from uw_dslam_ros2.io.heap import give_back, keep_apart

def resident_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6

"""
_LARGE = """
keep_apart()
np.ones(20 << 17)
before = resident_mb()
step = [np.ones(10 << 17) for _ in range(10)]  # 10 MB each
behind = [b"x" * 10_000 for _ in range(10)]
del step
print(resident_mb() - before)
"""
_SMALL = """
before = resident_mb()
step = [np.ones(1 << 12) for _ in range(1000)]  # 32 kB each
behind = step[-1]
del step
give_back()
print(resident_mb() - before)
"""


@pytest.mark.parametrize("program", [_LARGE, _SMALL])
def test_memory_is_given_back_although_something_small_lies_behind_it(program):
    command = [sys.executable, "-c", _START + program]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    assert float(done.stdout) < 8.0
