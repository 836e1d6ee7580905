"""Warn at the line of a user, and tell errors and warnings by their parts: what is wrong, and what helps."""

import contextlib
import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, NamedTuple, TypeVar

import openmm

#: Calls from these are not the user's own: OpenMM's Simulation creates Contexts, and context managers are entered here.
_FOLDERS = Path(__file__).parent.parent, Path(openmm.__file__).parent
_PACKAGES = (*(f"{folder}{os.sep}" for folder in _FOLDERS), contextlib.__file__)


class Remedy(NamedTuple):
    """Describe what helps against a fault.

    Attributes:
        kind: by which others than scripts have words of their own.
        words: for a script.
        detail: what all words name, such as a file or a step with its unit.
    """

    kind: str
    words: str
    detail: str = ""


Told = TypeVar("Told", bound="Advised")


class Advised(Exception):
    """Hold the parts of an error or a warning, from which scripts and the command make their sentences.

    Attributes:
        finding: what is wrong.
        remedies: what helps, any one of them.
        remark: what else is to be known; may be empty.
    """

    #: Between the finding and the remedies, which begin with a capital letter after a full stop.
    separator: ClassVar[str] = ". "

    def __init__(self, finding: str, *remedies: Remedy, remark: str = ""):
        self.finding, self.remedies, self.remark = finding, remedies, remark
        super().__init__(self.told())

    def within(self: Told, place: object) -> Told:
        """Return the same with a place in front, such as a file."""
        return type(self)(f"{place}: {self.finding}", *self.remedies, remark=self.remark)

    def told(self, words: Mapping[str, str] = MappingProxyType({})) -> str:
        """Return the sentence, for scripts or for others.

        Args:
            words: by kind of remedy, with {} for its detail; empty for a remedy that is not one there. Other kinds are
                told as for scripts.
        """
        ways = [words[each.kind].format(each.detail) if each.kind in words else each.words for each in self.remedies]
        advice = ", or ".join(dict.fromkeys(filter(None, ways)))
        if advice and self.separator.startswith("."):
            advice = advice[0].upper() + advice[1:]
        text = self.separator.join(filter(None, [self.finding, advice]))
        return ". ".join(filter(None, [text, self.remark]))


def notify(message: str | Warning) -> None:
    """Warn of behaviour that a user may not expect; the warning names the line that called the package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGES):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
