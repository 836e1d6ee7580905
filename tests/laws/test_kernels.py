"""The laws on the kernels engine, where it is installed, on OpenCL in double precision."""

import subprocess
import sys

import pytest

from tests.support import kernels, opencl

#: Laws of what an engine does. The others are those of files, of prepared Systems, and of the exact engine alone.
LAWS = (
    "order",
    "slow-order",
    "damping",
    "reversal",
    "requests",
    "settings",
    "restarts",
    "futures",
    "interruptions",
    "threads",
    "rejections",
    "gains",
    "moves",
    "averages",
)

#: Seconds. An example takes one of processor time, and a law that fails tries a hundred.
LIMIT = 3000


@pytest.mark.thorough
@pytest.mark.parametrize("examples", [3, pytest.param(100, marks=pytest.mark.hundreds)])
def test_laws_hold_on_kernels(request, examples):
    limit = LIMIT + 10 * examples * len(LAWS)
    request.node.add_marker(pytest.mark.timeout(limit + 60))
    if not kernels.are_here():
        pytest.skip(kernels.MISSING)
    place = ["--platform", "OpenCL", "--engine", "kernels", "--seed", "1"]
    command = [sys.executable, "-m", "tests.laws", "--law", *LAWS, *place, "--examples", str(examples)]
    environment = opencl.environment(optimizes=False)
    process = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=environment, check=False)
    assert process.returncode == 0, process.stdout[-8000:] + process.stderr[-2000:]
