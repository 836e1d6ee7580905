"""The parser of the command line, and arguments that several commands share."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    #: The action to which commands are added.
    Commands = argparse._SubParsersAction["Parser"]

FORCEFIELD_HELP = (
    "force-field files, OpenMM's or your own. Without it the file named in a record 'REMARK  99 FORCEFIELD file.xml' "
    "of the PDB file; without such a record the water model whose geometry the file has, if only one has it. Otherwise "
    "the error lists the models to choose from"
)


class UsageError(ValueError):
    """Arguments are wrong; the message begins with the command."""


class Parser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message} (see {self.prog} --help)")
