"""OpenMM's OpenCL platform on the CPU, by Intel's runtime from the package index (the extra `opencl-test`)."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def environment() -> dict[str, str]:
    """Return the environment in which Python must be started for OpenMM to find the runtime."""
    variables = dict(os.environ)
    library = Path(sys.prefix) / "lib"
    if runtimes := sorted(library.glob("libintelocl.so.*")):
        folders = [str(library), *filter(None, [variables.get("LD_LIBRARY_PATH")])]
        variables["LD_LIBRARY_PATH"] = os.pathsep.join(folders)
        variables.setdefault("OCL_ICD_FILENAMES", str(runtimes[-1]))
        # Of a Context's time, which is that of compiling its kernels, half goes into vectorizing them.
        variables.setdefault("CL_CONFIG_USE_VECTORIZER", "False")
    return variables
