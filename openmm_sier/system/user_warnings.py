"""Warnings that point to the line of a user's script."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

import openmm

#: Callers that are not the user: OpenMM's Simulation creates Contexts, and contextlib enters context managers.
_FOLDERS = Path(__file__).parent.parent, Path(openmm.__file__).parent
_PACKAGES = (*(f"{folder}{os.sep}" for folder in _FOLDERS), contextlib.__file__)


def warn(message: str | Warning) -> None:
    """Issue a warning at the line that called the package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGES):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
