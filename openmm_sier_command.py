"""Start the command `openmm-sier`, whose version and list of commands do not wait for OpenMM.

Python imports a package before its modules, and openmm_sier imports OpenMM. So this module is beside the package.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec, module_from_spec

#: Arguments of a command line that executes no command.
QUESTIONS = {"--help", "-h", "--version"}


def main() -> int:
    """Execute the command line of the process, and return the exit code."""
    if sys.argv[1:] and QUESTIONS.issuperset(sys.argv[1:]):
        _answer_without_package("openmm_sier")
    from openmm_sier.cli.main import main

    return main()


def _answer_without_package(name: str) -> None:
    """Let the modules of a package be imported without executing `__init__.py` of the package."""
    spec = find_spec(name)
    assert spec is not None
    sys.modules[name] = module_from_spec(spec)
