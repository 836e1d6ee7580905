"""Warn at the line of a user."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

import openmm

#: Calls from these are not the user's own: OpenMM's Simulation creates Contexts, and context managers are entered here.
_FOLDERS = Path(__file__).parent.parent, Path(openmm.__file__).parent
_PACKAGES = (*(f"{folder}{os.sep}" for folder in _FOLDERS), contextlib.__file__)


def warn(message: str | Warning) -> None:
    """Warn of behaviour that a user may not expect; the warning names the line that called the package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGES):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
