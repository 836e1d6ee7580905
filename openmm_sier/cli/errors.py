"""Errors of the commands that are no faults of the program."""

#: Exit code for wrong arguments.
MISUSED = 2


class RunError(ValueError):
    """The command cannot be carried out."""


class Misused(RunError):
    """Arguments of a command are wrong."""

    exit_code = MISUSED


class NothingLeft(RunError):
    """The run to be continued is already complete."""

    exit_code = 4
