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
FEW = "order", "reversal", "restarts"

#: Seconds after which two examples of each count as hanging.
LIMIT = 1200


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("laws", "examples", "limit"),
    [
        pytest.param(FEW, 2, LIMIT, marks=pytest.mark.timeout(LIMIT + 60)),
        pytest.param(LAWS, 100, 50 * LIMIT, marks=[pytest.mark.hundreds, pytest.mark.timeout(50 * LIMIT + 60)]),
    ],
)
def test_laws_hold_on_kernels(laws, examples, limit):
    if not kernels.are_here():
        pytest.skip(kernels.MISSING)
    place = ["--platform", "OpenCL", "--engine", "kernels", "--seed", "1"]
    command = [sys.executable, "-m", "tests.laws", "--law", *laws, *place, "--examples", str(examples)]
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=limit,
        env=opencl.environment(),
        check=False,
    )
    assert process.returncode == 0, process.stdout[-8000:] + process.stderr[-2000:]
