"""Locks on the files that a command writes, so that no other writes them at the same time."""

import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from filelock import FileLock, Timeout

from openmm_sier.cli.errors import RunError

#: Seconds to wait for a lock whose holder is ending.
PATIENCE = 0.2


class FileLocks(ExitStack):
    """Locks on files, held until this context manager ends.

    In the folder of each file, `.NAME.lock` is locked by the operating system, which releases the lock when the process
    ends or is killed. So a left lock file is harmless, and the next command removes it. On network file systems such
    locks hold for all machines.

    Nothing waits for a lock, so no two commands can wait for each other. Commands that lock the same first file never
    refuse each other both.
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: set[Path] = set()

    def hold(self, paths: Iterable[Path]) -> None:
        """Lock files that are not locked yet, whether they exist or not.

        Raises:
            RunError: another process holds one of them; the message names the file.
            OSError: a lock cannot be made.
        """
        for path in paths:
            # All names of a file, including links, have one lock.
            real = Path(os.path.realpath(path))
            place = real.with_name(f".{real.name}.lock")
            if place in self._held:
                continue
            try:
                self.enter_context(FileLock(place, timeout=PATIENCE))
            except Timeout:
                raise RunError(
                    f"{path} is being written by another process, or its lock {place} cannot be made"
                ) from None
            self._held.add(place)
            # Before the lock is released: a process that then locks the removed file notices that it is gone.
            self.callback(place.unlink, missing_ok=True)
