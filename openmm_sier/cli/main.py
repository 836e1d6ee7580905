"""Carries out command lines of `openmm-sier`. Each command has a module of its own, imported when it is needed."""

import os
import signal
import sys
import warnings
from importlib import import_module
from typing import Any

from openmm_sier.cli import streams
from openmm_sier.cli.command_line import MISUSED as MISUSED
from openmm_sier.cli.command_line import parse
from openmm_sier.cli.stopping import interrupt_behind
from openmm_sier.dynamics.backend.threads import cores

#: Exit codes. An error may have its own `exit_code`, and after signal n the code is 128 + n.
FAILED, SIGNALLED = 1, 128


def main(arguments: list[str] | None = None) -> int:
    """Execute a command line, that of this process unless given, and return the exit code."""
    streams.escape(sys.stdout)
    options = parse(arguments)
    if sys.stdout is None:
        streams.complain("standard output is closed; send it to a file, or to /dev/null")
        return FAILED
    # Otherwise OpenMM counts the cores of the machine, for the threads of PME even where a Context has fewer.
    os.environ.setdefault("OPENMM_CPU_THREADS", str(cores()))
    try:
        _execute(**vars(options))
    except KeyboardInterrupt as stop:
        streams.complain(str(stop) or "interrupted")
        return SIGNALLED + getattr(stop, "signum", signal.SIGINT)
    except BrokenPipeError:
        # Whatever read our output has ended, as `head` does: there is nobody to tell.
        streams.discard(sys.stdout)
        streams.discard(sys.stderr)
        return FAILED
    except Exception as error:
        if options.debug:
            raise
        streams.complain(streams.described(error))
        return getattr(error, "exit_code", FAILED)
    return 0


def _execute(command: str, debug: bool, **given: Any) -> None:
    """Carry out a command by the function `execute` of its module, whose arguments are named like the options."""
    with warnings.catch_warnings():
        warnings.showwarning = streams.note_warning
        try:
            import_module(f"openmm_sier.cli.{command}").execute(**given)
        except SystemError as error:
            if stop := interrupt_behind(error):
                raise stop from None
            raise
