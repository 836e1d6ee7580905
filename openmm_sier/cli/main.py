"""Carries out command lines of `openmm-sier`. Each command has a module of its own, imported when it is needed."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import warnings
from collections.abc import Callable

from openmm_sier.cli import streams
from openmm_sier.cli.stopping import interrupt_behind
from openmm_sier.dynamics.backend.threads import cores
from openmm_sier_command.arguments import parse
from openmm_sier_command.options import given_options
from openmm_sier_command.parser import MISUSED as MISUSED

#: Exit codes. An error may have its own `exit_code`, and after signal n the code is 128 + n.
FAILED, SIGNALLED = 1, 128


def main(arguments: list[str] | None = None) -> int:
    """Execute a command line and return the exit code."""
    return carry_out(parse(arguments))


def carry_out(options: argparse.Namespace) -> int:
    """Execute a command with parsed arguments and return the exit code."""
    if not streams.open_closed_streams():
        streams.complain("standard output is closed; send it to a file, or to /dev/null")
        return FAILED
    # Otherwise OpenMM counts the cores of the machine, for the threads of PME even where a Context has fewer.
    os.environ.setdefault("OPENMM_CPU_THREADS", str(cores()))
    try:
        _execute(options)
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


def _execute(options: argparse.Namespace) -> None:
    with warnings.catch_warnings():
        warnings.showwarning = streams.note_warning
        execute = COMMANDS.get(options.command) or options.execute
        try:
            execute(options)
        except SystemError as error:
            if stop := interrupt_behind(error):
                raise stop from None
            raise


def _run(options: argparse.Namespace) -> None:
    from openmm_sier.cli import run

    run.run(given_options(options))


def _ensemble(options: argparse.Namespace) -> None:
    from openmm_sier.cli import ensembles

    ensembles.run(options.plan, options.out, options.processes, options.threads, options.scheduler, options.list)


def _properties(options: argparse.Namespace) -> None:
    from openmm_sier.cli import properties

    properties.properties_of(options.runs, options.box, options.skip, options.viscosity, options.out)


def _validate(options: argparse.Namespace) -> None:
    from openmm_sier.cli import validate

    validate.validate(options.runs, options.skip, options.limit)


def _tune(options: argparse.Namespace) -> None:
    from openmm_sier.cli import tune

    tune.run(given_options(options), options.acceptance, options.trials, options.samples)


def _info(options: argparse.Namespace) -> None:
    from openmm_sier.cli import info

    info.info(options.box, options.forcefield, options.rigid, options.constraints)


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "run": _run,
    "ensemble": _ensemble,
    "properties": _properties,
    "validate": _validate,
    "tune": _tune,
    "info": _info,
}

if __name__ == "__main__":
    sys.exit(main())
