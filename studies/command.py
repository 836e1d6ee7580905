"""Studies as commands: the fields of a dataclass of settings are the options, and its docstring is their help.

A field that is not for keywords alone, such as a box, may also stand first, without its name.
"""

import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from time import monotonic
from typing import Any, ClassVar, TypeVar

import openmm
from cyclopts import App, CycloptsError, Parameter

from studies.report import PrintedReport, Report

#: The boxes of the repository.
SYSTEMS = Path(__file__).parents[1] / "systems"

#: The program that Python was started with, and the whole command.
PROGRAM = f"python -m {getattr(sys.modules['__main__'].__spec__, 'name', 'studies').removesuffix('.__main__')}"
THREADS = f"OPENMM_CPU_THREADS={os.environ['OPENMM_CPU_THREADS']} " if "OPENMM_CPU_THREADS" in os.environ else ""
COMMAND = f"{THREADS}{PROGRAM} {shlex.join(sys.argv[1:])}".rstrip()

#: When this module was read.
BEGUN = monotonic()

#: What a study says in one line; any other exception is a fault of the program and shows where.
EXPECTED = (ValueError, OSError, ImportError, openmm.OpenMMException)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What all studies take.

    Attributes:
        out: directory for numbers and figures.
        seed: of everything random.
    """

    out: Path = Path("out")
    seed: int = 1

    #: Names of numbers that need not be above 0.
    ANY_SIGN: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, bool) or not isinstance(number, (int, float)) or name in self.ANY_SIGN:
                    continue
                if not (math.isfinite(number) and number > 0):
                    raise ValueError(f"{name} must be above 0, got {number}")

    def recorded(self) -> dict[str, Any]:
        """Return what is written beside results: files by their names, and not where results go."""
        return {each.name: _named(getattr(self, each.name)) for each in fields(self) if each.name != "out"}


def _named(value: Any) -> Any:
    """Return a value with files by their names, also in tuples."""
    if isinstance(value, tuple):
        return tuple(map(_named, value))
    return value.name if isinstance(value, Path) else value


@dataclass(frozen=True, kw_only=True)
class BoxSettings(Settings):
    """What studies of a box take.

    Attributes:
        box: PDB file.
        forcefield: files; without them that of the PDB file.
        temperature: K.
        platform: of OpenMM; None takes the fastest.
    """

    box: Path = field(default=SYSTEMS / "tip3p-512.pdb", kw_only=False)
    forcefield: tuple[str, ...] = ()
    temperature: float = 297.0
    platform: str | None = None


@dataclass(frozen=True, kw_only=True)
class RunsSettings(Settings):
    """Settings of studies that store their runs one by one, so that an interrupted study continues.

    Attributes:
        processes: that make runs at the same time.
    """

    processes: int = 1

    #: Names of settings that all runs of a directory have in common.
    SHARED: ClassVar[tuple[str, ...]] = ()

    def shared(self) -> dict[str, Any]:
        return {name: self.recorded()[name] for name in self.SHARED}


Given = TypeVar("Given", bound=Settings)


def command(
    kind: type[Given], study: Callable[[Given, Report], object], description: str | None, module: str
) -> Callable[[Sequence[str] | None], int]:
    """Make the function `main` of a study, and call it in the module that Python was started with.

    Args:
        kind: of the settings.
        study: takes settings, and a report for tables, notes and progress.
        description: for the help.
        module: `__name__` of the study's module, whose last line this is.

    Returns:
        A function of the arguments of the command line, None for those of the process, that gives the exit code. What
        is wrong is said in one line on standard error.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        # The last of several values counts, as elsewhere.
        shared = Parameter(consume_multiple=True, allow_repeating=True, negative_iterable="")
        app = App(
            name=PROGRAM, help=description or "", help_format="plaintext", version_flags=[], default_parameter=shared
        )
        app.default(kind)
        try:
            settings = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
        except (CycloptsError, ValueError) as error:
            print(" ".join(str(error).split()), file=sys.stderr)
            raise SystemExit(2) from None
        if not isinstance(settings, kind):
            # It has printed the help.
            return 0
        try:
            settings.out.mkdir(parents=True, exist_ok=True)
            study(settings, PrintedReport())
        except EXPECTED as error:
            print(" ".join(str(error).split()), file=sys.stderr)
            return 1
        return 0

    if module == "__main__":
        sys.exit(main())
    return main


def elapsed() -> str:
    """Return how long this process has been running since it read this module, with a unit."""
    seconds = monotonic() - BEGUN
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"


def chosen(names: Sequence[str], choices: dict[str, Any], what: str) -> list[Any]:
    """Return the values of names; all of them where none is named.

    Raises:
        ValueError: a name is unknown.
    """
    for name in names:
        if name not in choices:
            raise ValueError(f"unknown {what} {name!r}; known are {', '.join(choices)}")
    return [choices[name] for name in names or choices]


def claim(path: Path, settings: dict[str, Any]) -> None:
    """Note the settings that all results of a directory share, or refuse settings that differ from those noted.

    Raises:
        ValueError: the directory has results of other settings.
    """
    own_settings = json.loads(json.dumps(settings))
    if not path.exists():
        path.write_text(json.dumps(own_settings, indent=1))
        return
    stored_settings = json.loads(path.read_text())
    for name, value in own_settings.items():
        if stored_settings[name] != value:
            raise ValueError(
                f"{path.parent} has results with {name} {stored_settings[name]}, got {value}: take another directory "
                "for --out"
            )
