"""The laws on the kernels engine, where it is installed, on OpenCL in double precision."""

import subprocess
import sys

import pytest

from tests.support import kernels, opencl

#: Laws that say something about an engine whose steps OpenMM makes, and those whose examples take one or two Contexts.
LAWS = (
    "order",
    "slow-order",
    "reversal",
    "damping",
    "requests",
    "settings",
    "restarts",
    "futures",
    "rejections",
    "gains",
)
#: Seconds. OpenMM compiles some hundred kernels for each Context, and a law that fails makes a hundred Contexts.
LIMIT = 60_000


@pytest.mark.thorough
@pytest.mark.hundreds
@pytest.mark.timeout(LIMIT + 60)
def test_laws_hold_on_kernels():
    if not kernels.are_here():
        pytest.skip(kernels.MISSING)
    place = ["--platform", "OpenCL", "--engine", "kernels", "--seed", "1"]
    command = [sys.executable, "-m", "tests.laws", "--law", *LAWS, *place, "--examples", "100"]
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        env=opencl.environment(),
        check=False,
    )
    assert process.returncode == 0, process.stdout[-8000:] + process.stderr[-2000:]
