"""Files that are either whole or not there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file, all of it or nothing.

    Args:
        path: of the file, which is replaced if it exists.
        write: writes to the path that it is given, beside the file and with the same ending.
    """
    temporary = path.with_name("new-" + path.name)
    write(temporary)
    temporary.replace(path)
