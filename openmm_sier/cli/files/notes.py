"""The notes in a checkpoint beside its plan: what they must be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openmm_sier_command.options import MOST_STEPS, OptionError
from openmm_sier_command.values import Kind, Number, Whole, Word, WrongValueError

_ENERGY = Number("kJ/mol", -1e15, 1e15)

#: Entries by name, each with whether it must be there: the identity of the run, and numbers.
ENTRIES: dict[str, tuple[Kind, bool]] = {
    "run": (Word(), True),
    "step": (Whole(0, MOST_STEPS), True),
    "potential_energy": (_ENERGY, True),
    "start_energy": (_ENERGY, False),
}

#: Files that grow, by name, each with whether every run has it; and what is noted of each. Counts in DCD files have
#: 32 bits.
FILES = {"trajectory": True, "log": True, "bodies": False, "tensors": False}
FILE: dict[str, Kind] = {"size": Whole(0, 2**63 - 1), "count": Whole(0, 2**31 - 1), "fingerprint": Word()}


def check_notes(path: Path, notes: Mapping[str, Any]) -> None:
    """Check what a checkpoint notes, its plan excepted (`openmm_sier.cli.plan.noted_plan`).

    Raises:
        OptionError: naming the checkpoint and the entry.
    """
    for name, (kind, needed) in ENTRIES.items():
        if needed or notes.get(name) is not None:
            _check(path, name, kind, notes.get(name))
    if "plan" not in notes:
        raise OptionError(f"{path}: plan is missing")


def check_files(path: Path, notes: Mapping[str, Any]) -> None:
    """Check what a checkpoint notes of the files of its run.

    Raises:
        OptionError: naming the checkpoint and the entry.
    """
    for name, needed in FILES.items():
        if not needed and name not in notes:
            continue
        noted = notes.get(name)
        if not isinstance(noted, dict) or set(noted) != set(FILE):
            raise OptionError(f"{path}: {name}: expected {', '.join(FILE)}, got {noted!r}")
        for part, kind in FILE.items():
            _check(path, f"{name}.{part}", kind, noted[part])


def _check(path: Path, name: str, kind: Kind, value: object) -> None:
    try:
        kind.check(value)
    except WrongValueError as error:
        raise OptionError(f"{path}: {name}: {error}") from None
