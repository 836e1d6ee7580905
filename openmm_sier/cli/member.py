"""A member of an ensemble in a process of its own: `python -m openmm_sier.cli.member COMMAND ...`.

The arguments are a command line of `openmm-sier`. It is executed in the current directory, and goes on from where an
earlier process ended. The process ends when its standard input does, so that it does not outlive the one that started
it. Signals other than SIGKILL are ignored. They would make a run write a checkpoint at once, and on the CPU platform a
checkpoint at a step where the undisturbed run has none changes the last bits of what follows.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from filelock import FileLock

from openmm_sier.cli.files import records
from openmm_sier.cli.main import main
from openmm_sier.cli.plan import NothingLeft
from openmm_sier.cli.pool import COMPLETE, LOCK, NOTES, read_arguments
from openmm_sier.engines.interrupts import SIGNALS

#: Names of the files of a run.
TRAJECTORY, CHECKPOINT = "run.dcd", "run.chk"

#: Options of `openmm-sier run` that may change between calls. The member goes on to its new length.
LENGTHS = ("--time", "--steps")

#: Exit code for a directory that holds another member.
FAILED = 1


def execute(arguments: list[str], command: Callable[[list[str]], int] | None = None) -> int:
    """Finish the member in the current directory and return the exit code.

    Args:
        arguments: of the member.
        command: takes them, writes its files here and returns its exit code; None is `openmm-sier`. Repeating it must
            give the same files.
    """
    # Two workers may get the same member if a scheduler believes the first one dead: the second then waits.
    with FileLock(LOCK):
        if read_arguments(Path(COMPLETE)) == arguments:
            return 0
        identity = _identity(arguments)
        noted = read_arguments(Path(NOTES))
        if noted is None and Path(NOTES).exists():
            # It is damaged: what the checkpoint belongs to is not known.
            Path(CHECKPOINT).unlink(missing_ok=True)
        if noted not in (None, identity):
            there = " ".join(sorted(set(noted) - set(identity))) or "fewer options"
            print(f"{Path.cwd()} has another member, with {there}: choose another directory", file=sys.stderr)
            return FAILED
        _write(NOTES, identity)
        code = main([*arguments, *_places()]) if command is None else command(arguments)
        if code not in (0, NothingLeft.exit_code):
            return code
        _write(COMPLETE, arguments)
        return 0


def _places() -> list[str]:
    """Options for the files that a run writes, and the checkpoint from which it goes on."""
    if not Path(CHECKPOINT).exists():
        # What was written before the first checkpoint is written again.
        return ["--out", TRAJECTORY, "--overwrite"]
    return ["--restart", CHECKPOINT]


def _identity(arguments: list[str]) -> list[str]:
    """The arguments without the length of a run."""
    left_out = {i + k for i, argument in enumerate(arguments) if argument in LENGTHS for k in (0, 1)}
    return [argument for i, argument in enumerate(arguments) if i not in left_out]


def _write(path: str, content: list[str]) -> None:
    with records.replacing(Path(path)) as made:
        made.write_text(json.dumps(content, indent=1))


def _end_with_parent() -> None:
    """End this process when its standard input ends; its files are valid at any moment."""
    # Not through sys.stdin, whose lock the interpreter needs when it exits.
    while os.read(0, 1024):
        pass
    os._exit(128 + signal.SIGTERM)


def serve(command: Callable[[list[str]], int] | None = None) -> NoReturn:
    """Execute the arguments of this process, see `execute`, and end it."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.exit(execute(sys.argv[1:], command))


if __name__ == "__main__":
    serve()
