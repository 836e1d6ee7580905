"""GPU platforms of OpenMM that work here, of which OpenCL may run on the CPU."""

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
    """Return the environment in which Python must be started for OpenMM to find Intel's runtime of OpenCL."""
    variables = dict(os.environ)
    library = Path(sys.prefix) / "lib"
    if runtimes := sorted(library.glob("libintelocl.so.*")):
        folders = [str(library), *filter(None, [variables.get("LD_LIBRARY_PATH")])]
        variables["LD_LIBRARY_PATH"] = os.pathsep.join(folders)
        variables.setdefault("OCL_ICD_FILENAMES", str(runtimes[-1]))
        # Of a Context's time, which is that of compiling its kernels, half goes into vectorizing them.
        variables.setdefault("CL_CONFIG_USE_VECTORIZER", "False")
    return variables


@functools.cache
def gpu_platforms() -> tuple[str, ...]:
    """Names of the platforms CUDA, HIP and OpenCL that work in this environment."""
    process = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=600, env=environment(), check=False
    )
    # Drivers may print words of their own.
    return tuple(name for name in ("CUDA", "HIP", "OpenCL") if name in process.stdout.split())
