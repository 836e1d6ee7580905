"""GPU platforms of OpenMM that work here, of which OpenCL may run on the CPU."""

import atexit
import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from studies.launches import opencl, shim

#: Prints the names of the platforms on which a Context can be made.
PROBE = """
import openmm
system = openmm.System()
system.addParticle(1.0)
for i in range(openmm.Platform.getNumPlatforms()):
    platform = openmm.Platform.getPlatform(i)
    try:
        openmm.Context(system, openmm.VerletIntegrator(0.001), platform)
    except openmm.OpenMMException:
        continue
    print(platform.getName())
"""

#: Keeps programs that OpenCL has compiled.
PROGRAMS = Path(__file__).with_name("opencl_programs.c")

#: Variable of options for OpenCL's compiler, which `PROGRAMS` adds.
OPTIONS = "OPENMM_SIER_OPENCL_OPTIONS"

#: The option without optimization, which takes half the time of a Context; kernels of a few molecules take no time.
PLAIN = "-cl-opt-disable"


def environment(optimizes: bool = True) -> dict[str, str]:
    """Return the environment in which Python must be started for OpenMM to find OpenCL on the CPU.

    Where there is a C compiler, Contexts with the same kernels compile them once in a process.

    Args:
        optimizes: whether OpenCL optimizes them.
    """
    variables = opencl.environment() | {OPTIONS: "" if optimizes else PLAIN}
    library = _kept_programs()
    return variables if library is None else variables | {"LD_PRELOAD": str(library)}


def has_environment() -> bool:
    """Return whether this process has an environment of this module."""
    return OPTIONS in os.environ


@functools.cache
def _kept_programs() -> Path | None:
    """Return the library of `PROGRAMS`, which is there until this process ends; None without a compiler for Linux."""
    if not sys.platform.startswith("linux") or shim.compiler() is None:
        return None
    folder = tempfile.mkdtemp(prefix="openmm-sier-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return shim.build(Path(folder), PROGRAMS)


@functools.cache
def gpu_platforms() -> tuple[str, ...]:
    """Names of the platforms CUDA, HIP and OpenCL that work in this environment."""
    process = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=600, env=environment(), check=False
    )
    # Drivers may print words of their own.
    return tuple(name for name in ("CUDA", "HIP", "OpenCL") if name in process.stdout.split())
