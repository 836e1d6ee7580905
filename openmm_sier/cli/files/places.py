"""Checks before a command writes a file: it must not replace inputs, other outputs, or files of the user."""

import os
from collections.abc import Iterable
from pathlib import Path

from openmm_sier.cli.errors import RunError
from openmm_sier.inputs.source_files import FilePath


def check_place(path: Path, inputs: Iterable[FilePath], outputs: Iterable[Path] = ()) -> None:
    """Refuse a file that would overwrite another or cannot be written.

    Args:
        path: of the file.
        inputs, outputs: other files that the command reads and writes.

    Raises:
        RunError: naming the file.
    """
    for other in inputs:
        if same_file(path, other):
            raise RunError(f"{path} would overwrite the input {other}: give another name")
    for other in outputs:
        if same_file(path, other):
            raise RunError(f"{path} and {other} are the same: outputs must be different files")
    # For example a device: /dev/null would be replaced by a file.
    if path.exists() and not path.is_file():
        raise RunError(f"{path} is not a regular file")
    if not path.parent.is_dir():
        raise RunError(f"there is no directory {path.parent} for {path.name}: make it, or give another name")


def refuse_to_replace(path: Path) -> None:
    """Refuse a file that exists.

    Raises:
        RunError: naming the file.
    """
    if os.path.lexists(path):
        raise RunError(f"{path} exists: give another name, or replace it with --overwrite")


def same_file(one: FilePath, two: FilePath) -> bool:
    """Return whether two names lead to the same file, also through links; neither has to exist."""
    try:
        return os.path.samefile(one, two)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(two)
