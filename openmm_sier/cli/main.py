"""Execute command lines of `openmm-sier`. The module of each command is imported when it is needed."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from openmm_sier.cli import streams
from openmm_sier.cli.errors import MISUSED as MISUSED
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.stopping import interrupt_behind
from openmm_sier.dynamics.threads import cores

if TYPE_CHECKING:
    from openmm_sier.cli.command_line import Call

#: Exit codes. An error may have its own `exit_code`, and after signal n the code is 128 + n.
FAILED, SIGNALLED = 1, 128


def main(arguments: list[str] | None = None) -> int:
    """Execute a command line, by default that of the process, and return the exit code."""
    streams.escape(sys.stdout)
    try:
        call = _parse(arguments)
    except (Misused, ModuleNotFoundError) as error:
        streams.complain(streams.described(error))
        return getattr(error, "exit_code", FAILED)
    if sys.stdout is None:
        streams.complain("standard output is closed; send it to a file, or to /dev/null")
        return FAILED
    # Otherwise OpenMM counts the cores of the machine, for the threads of PME even where a Context has fewer.
    os.environ.setdefault("OPENMM_CPU_THREADS", str(cores()))
    try:
        _execute(call.carry_out)
    except KeyboardInterrupt as stop:
        streams.complain(str(stop) or "interrupted")
        return SIGNALLED + getattr(stop, "signum", signal.SIGINT)
    except BrokenPipeError:
        # The reader of standard error has ended.
        streams.discard(sys.stdout)
        streams.discard(sys.stderr)
        return FAILED
    except Exception as error:
        if call.debug:
            raise
        streams.complain(streams.described(error))
        return getattr(error, "exit_code", FAILED)
    return 0


def _parse(arguments: list[str] | None) -> Call:
    # Its libraries come with an extra, which may not be installed.
    from openmm_sier.cli.command_line import parse

    return parse(arguments)


def _execute(carry_out: Callable[[], Any]) -> None:
    """Execute a command, with warnings among its notes."""
    with warnings.catch_warnings():
        warnings.showwarning = streams.note_warning
        try:
            carry_out()
        except SystemError as error:
            if stop := interrupt_behind(error):
                raise stop from None
            raise
