"""OpenMM's OpenCL platform on the CPU, by Intel's runtime from the package index (the extra `opencl-test`)."""

import functools
import os
import subprocess
import sys
from pathlib import Path

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


def environment() -> dict[str, str]:
    """The environment in which Python must be started for OpenMM to find the runtime."""
    variables = dict(os.environ)
    library = Path(sys.prefix) / "lib"
    if runtimes := sorted(library.glob("libintelocl.so.*")):
        found = [str(library), *filter(None, [variables.get("LD_LIBRARY_PATH")])]
        variables["LD_LIBRARY_PATH"] = os.pathsep.join(found)
        variables.setdefault("OCL_ICD_FILENAMES", str(runtimes[-1]))
    return variables


@functools.cache
def gpu_platforms() -> tuple[str, ...]:
    """Names of the platforms CUDA, HIP and OpenCL that work in this environment."""
    done = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=600, env=environment(), check=False
    )
    return tuple(name for name in done.stdout.split() if name in ("CUDA", "HIP", "OpenCL"))
