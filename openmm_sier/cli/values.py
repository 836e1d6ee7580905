"""Kinds of values: what is accepted, from a command line and from a file alike."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any


class WrongValueError(ArgumentTypeError, ValueError):
    """A value is not what was expected; the message says what that is, and what came."""

    def __init__(self, expected: str, got: object, remark: str = ""):
        super().__init__(f"expected {expected}, got {got!r}{remark}")


@dataclass(frozen=True)
class Kind:
    """What an option takes.

    Attributes:
        expected: in words, for messages.
        accepts: whether a value that TOML or JSON hold is of this kind.
        made: what an accepted value is for the program.
        parse: what a word of the command line would be in a file; a ValueError where it is nothing of the kind.
        metavar: stands for a value in `--help`.
        file: "input" or "output" for the name of a file that a command reads or writes.
        remark: what to say after a value that is not accepted, if anything.
        each: the kind of each of several values, for which a command line has a word each; None for a single one.
        count: how many these are; 0 for one or more.
    """

    expected: str
    accepts: Callable[[Any], bool]
    made: Callable[[Any], Any] = lambda value: value
    parse: Callable[[str], Any] = str
    metavar: str = "VALUE"
    file: str = ""
    remark: Callable[[Any], str] | None = None
    each: Kind | None = None
    count: int = 0

    def check(self, value: object, got: object = None) -> Any:
        """The value that a file holds.

        Args:
            value: in the file.
            got: the word of a command line that it comes from.

        Raises:
            WrongValueError: it is not of this kind.
        """
        if not self.accepts(value):
            remark = self.remark(value) if self.remark else ""
            raise WrongValueError(self.expected, value if got is None else got, remark)
        return self.made(value)

    def read(self, text: str) -> Any:
        """The value that a word of the command line means.

        Raises:
            WrongValueError: it is not of this kind.
        """
        try:
            value = self.parse(text)
        except ValueError:
            raise WrongValueError(self.expected, text) from None
        return self.check(value, text)


def number(unit: str, least: float, most: float, beyond: bool = False, hint: str = "") -> Kind:
    """A number from `least` to `most`, in a unit.

    Args:
        unit, least, most: of the number.
        beyond: whether `least` itself is left out.
        hint: for whoever is out of range.
    """
    within = f"above {least:g} and up to" if beyond else f"from {least:g} to"

    def accepts(value: Any) -> bool:
        # NaN is not in any range.
        return type(value) in (int, float) and least <= value <= most and not (beyond and value == least)

    expected = f"a number {within} {most:g} {unit}".rstrip() + hint
    return Kind(expected, accepts, float, float, unit.upper() or "VALUE")


def whole(least: int = 1, most: int = 2**31 - 1) -> Kind:
    """A whole number from `least` to `most`."""

    def accepts(value: Any) -> bool:
        return type(value) is int and least <= value <= most

    return Kind(f"a whole number from {least} to {most}", accepts, parse=int, metavar="N")


def choice(*names: str) -> Kind:
    """One of a few names."""
    return Kind(f"one of {', '.join(names)}", lambda value: value in names, metavar=f"{{{','.join(names)}}}")


def word(metavar: str = "NAME") -> Kind:
    """A name, of a residue or a platform."""

    def accepts(value: Any) -> bool:
        return isinstance(value, str) and value.strip() != "" and value.isprintable()

    return Kind("a name", accepts, metavar=metavar)


def file(metavar: str = "FILE", use: str = "input") -> Kind:
    """The name of a file that a command reads (`use` is "input") or writes ("output")."""

    def accepts(value: Any) -> bool:
        if not isinstance(value, str) or "\0" in value or not value:
            return False
        # The root, this directory and the one above are no files, and outputs may be named after inputs.
        return Path(value).name not in ("", "..")

    return Kind("the name of a file", accepts, Path, metavar=metavar, file=use)


def several(kind: Kind, count: int = 0) -> Kind:
    """One or more values of a kind, or a certain number of them."""

    def accepts(value: Any) -> bool:
        return isinstance(value, list) and (len(value) == count if count else value != [])

    def made(value: Any) -> list[Any]:
        return [kind.check(item) for item in value]

    expected = f"a list of {count} values" if count else "a list with at least one value"
    return Kind(expected, accepts, made, metavar=kind.metavar, file=kind.file, each=kind, count=count)


def step(least: float, most: float) -> Kind:
    """A step in fs."""
    kind = number("fs", least, most)

    def remark(value: Any) -> str:
        meant = 1000 * value if type(value) in (int, float) else 0.0
        is_in_ps = least <= meant <= most and value < least
        return f" fs. It is in fs, not in ps: did you mean {meant:g}?" if is_in_ps else ""

    return replace(kind, remark=remark)


#: The name of a picture, whose format follows from its ending.
PICTURE = file("FILE.png|svg|html", "output")

#: A length of time.
TIME = number("ps", 0, 1e9, beyond=True)

#: Yes or no; on a command line the option alone.
SWITCH = Kind("true or false", lambda value: isinstance(value, bool))
