"""Parsers that complain in one line, and arguments that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

from openmm_sier_command.values import Kind, WrongValueError

if TYPE_CHECKING:
    #: The action to which commands are added.
    Commands = argparse._SubParsersAction["Parser"]

FORCEFIELD_HELP = (
    "force-field files, OpenMM's or your own (default: the file named in a record 'REMARK  99 FORCEFIELD file.xml' of "
    "the PDB file; without such a record the water model whose geometry the file has, if only one has it. Otherwise "
    "the error lists the models to choose from)"
)


#: Exit code for wrong arguments.
MISUSED = 2


class Parser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(MISUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def reading(kind: Kind) -> Callable[[str], Any]:
    """A kind of value as a type of argparse."""

    def read(text: str) -> Any:
        try:
            return kind.read(text)
        except WrongValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read
