"""GPU platforms of OpenMM that work here, of which OpenCL may run on the CPU."""

import functools
import subprocess
import sys

from studies.launches.opencl import environment

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


@functools.cache
def gpu_platforms() -> tuple[str, ...]:
    """Names of the platforms CUDA, HIP and OpenCL that work in this environment."""
    process = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=600, env=environment(), check=False
    )
    # Drivers may print words of their own.
    return tuple(name for name in ("CUDA", "HIP", "OpenCL") if name in process.stdout.split())
