"""Starts the tests of GPU platforms, which need an environment that is set before Python starts."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import opencl

SUITE = Path(__file__).with_name("on_gpu_platforms.py")

#: Seconds after which the suite counts as hanging. Without a GPU a Context takes 6 s, in which kernels are compiled.
LIMIT = 3000


@pytest.mark.thorough
@pytest.mark.timeout(LIMIT + 60)
def test_on_gpu_platforms():
    if not opencl.gpu_platforms():
        pytest.skip(
            "OpenMM has no CUDA, HIP or OpenCL platform here: pip install 'openmm-sier[opencl-test]' brings OpenCL "
            "on the CPU"
        )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(SUITE)]
    process = subprocess.run(
        command, capture_output=True, text=True, timeout=LIMIT, env=opencl.environment(), check=False
    )
    assert process.returncode == 0, process.stdout[-8000:] + process.stderr[-2000:]
