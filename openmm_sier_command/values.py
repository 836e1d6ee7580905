"""Kinds of values: what is accepted, from a command line and from a file alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


class WrongValueError(ValueError):
    """A value is not what was expected; the message says what that is, and what came."""

    def __init__(self, expected: str, got: object):
        super().__init__(f"expected {expected}, got {got!r}")


class Kind(Protocol):
    """What an option takes.

    `read` takes a word of the command line, `check` what TOML or JSON hold; both raise `WrongValueError`.
    """

    @property
    def metavar(self) -> str | None:
        """Stands for a value in `--help`."""

    def read(self, text: str) -> Any:
        """The value that a word of the command line means."""

    def check(self, value: object) -> Any:
        """The value that a file holds."""


@dataclass(frozen=True)
class Number:
    """A number from `least` to `most`, in a unit.

    Attributes:
        beyond: whether `least` itself is left out.
        hint: for whoever is out of range.
    """

    unit: str
    least: float
    most: float
    beyond: bool = False
    hint: str = ""

    @property
    def metavar(self) -> str:
        return self.unit.upper()

    def read(self, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise WrongValueError(self._expected, text) from None
        return self._in_range(value, text)

    def check(self, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise WrongValueError(self._expected, value)
        try:
            return self._in_range(float(value), value)
        except OverflowError:
            raise WrongValueError(self._expected, value) from None

    def _in_range(self, value: float, given: object) -> float:
        # NaN is not in any range.
        if not self.least <= value <= self.most or (self.beyond and value == self.least):
            raise WrongValueError(self._expected, given)
        return value

    @property
    def _expected(self) -> str:
        within = f"above {self.least:g} and up to" if self.beyond else f"from {self.least:g} to"
        return f"a number {within} {self.most:g} {self.unit}".rstrip() + self.hint


@dataclass(frozen=True)
class Whole:
    """A whole number from `least` to `most`."""

    least: int = 1
    most: int = 2**31 - 1
    metavar: str | None = "N"

    def read(self, text: str) -> int:
        # More digits than any range here has; Python refuses to convert thousands of them.
        if not (text.isascii() and text.isdigit() and len(text) <= 20):
            raise WrongValueError(self._expected, text)
        return self.check(int(text))

    def check(self, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not self.least <= value <= self.most:
            raise WrongValueError(self._expected, value)
        return value

    @property
    def _expected(self) -> str:
        return f"a whole number from {self.least} to {self.most}"


@dataclass(frozen=True)
class Choice:
    """One of a few names."""

    names: tuple[str, ...]

    @property
    def metavar(self) -> str:
        return f"{{{','.join(self.names)}}}"

    def read(self, text: str) -> str:
        return self.check(text)

    def check(self, value: object) -> str:
        if not isinstance(value, str) or value not in self.names:
            raise WrongValueError(f"one of {', '.join(self.names)}", value)
        return value


@dataclass(frozen=True)
class Word:
    """A name, of a residue or a platform."""

    metavar: str | None = "NAME"

    def read(self, text: str) -> str:
        return self.check(text)

    def check(self, value: object) -> str:
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            raise WrongValueError("a name", value)
        return value


@dataclass(frozen=True)
class File:
    """The name of a file that a run reads or, if `output`, writes."""

    metavar: str | None = "FILE"
    output: bool = False

    def read(self, text: str) -> Path:
        return self.check(text)

    def check(self, value: object) -> Path:
        if not isinstance(value, str) or not value or "\0" in value:
            raise WrongValueError("the name of a file", value)
        return Path(value)


@dataclass(frozen=True)
class Switch:
    """Yes or no."""

    metavar: str | None = None

    def read(self, text: str) -> bool:
        raise WrongValueError("no value", text)

    def check(self, value: object) -> bool:
        if not isinstance(value, bool):
            raise WrongValueError("true or false", value)
        return value


@dataclass(frozen=True)
class Several:
    """One or more values of a kind."""

    of: Kind

    @property
    def metavar(self) -> str | None:
        return self.of.metavar

    def read(self, text: str) -> Any:
        return self.of.read(text)

    def check(self, value: object) -> list[Any]:
        if not isinstance(value, list) or not value:
            raise WrongValueError("a list with at least one value", value)
        return [self.of.check(item) for item in value]


#: Kinds that several commands share.
COUNT = Whole()
TIME = Number("ps", 0, 1e9, beyond=True)
