"""The kernels engine where it is not installed, and its tests with compiled kernels, which need another environment."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import openmm
import pytest

from openmm_sier import SIERIntegrator
from tests.support import kernels, opencl
from tests.support.systems import assembled

SUITE = Path(__file__).with_name("on_kernels.py")

#: Seconds after which the suite counts as hanging. A Context takes some 4 s on a CPU, which compiles its kernels.
LIMIT = 1800


def test_without_the_package_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "openmm_sier_kernels", None)
    integrator = SIERIntegrator(0.004, engine="kernels")
    with pytest.raises(openmm.OpenMMException, match=r"pip install \./kernels"):
        openmm.Context(assembled([1.0]), integrator, openmm.Platform.getPlatformByName("Reference"))


def test_a_platform_without_kernels_is_refused(monkeypatch):
    def library(name):
        raise openmm.OpenMMException(f"not for the {name} platform")

    monkeypatch.setitem(sys.modules, "openmm_sier_kernels", SimpleNamespace(library=library))
    integrator = SIERIntegrator(0.004, engine="kernels")
    with pytest.raises(openmm.OpenMMException, match="Reference platform"):
        openmm.Context(assembled([1.0]), integrator, openmm.Platform.getPlatformByName("Reference"))


@pytest.mark.thorough
@pytest.mark.timeout(LIMIT + 60)
def test_on_kernels():
    if not kernels.are_here():
        pytest.skip(kernels.MISSING)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(SUITE)]
    process = subprocess.run(
        command, capture_output=True, text=True, timeout=LIMIT, env=opencl.environment(), check=False
    )
    assert process.returncode == 0, process.stdout[-8000:] + process.stderr[-2000:]
