"""The package openmm-sier-kernels, where it is installed."""

from __future__ import annotations

import importlib
from typing import Any

import openmm

#: How to install it.
INSTALL = "install it by pip install ./kernels in the repository of openmm_sier"


def library_of(platform: openmm.Platform) -> Any:
    """Return the compiled library of a platform, see `openmm_sier_kernels.Library`.

    Raises:
        openmm.OpenMMException: the package is not installed, was built for another version of OpenMM, or has no library
            for this platform.
    """
    try:
        package = importlib.import_module("openmm_sier_kernels")
    except ImportError as error:
        raise openmm.OpenMMException(
            f"The kernels engine needs the package openmm-sier-kernels, which cannot be imported ({error}): {INSTALL}, "
            "or take engine='native'"
        ) from error
    return package.library(platform.getName())


def address_of(integrator: openmm.CustomIntegrator) -> int:
    """Return the address by which a library knows an integrator."""
    return int(integrator.this)
