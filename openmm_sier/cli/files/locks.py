"""Locks on the files that a command writes, so that no other writes them at the same time."""

import os
import re
import shlex
import socket
import sys
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from datetime import datetime, timezone
from pathlib import Path

from filelock import FileLock, Timeout

from openmm_sier.cli.errors import RunError
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.system.untrusted_files import open_regular

#: Seconds to wait for a lock: for one whose holder is just ending, not for a run.
PATIENCE = 0.2

#: Characters of a command in a message, and bytes of a lock file that are read.
LONGEST, LONGEST_HOLDER = 200, 2**12


#: What a lock holds: nothing yet, or by whom it is held.
CONTENT = re.compile(rb"(process \d+ on .* since \d{4}-\d\d-\d\d .*)?", re.DOTALL)


class FileLocks(ExitStack):
    """Locks on files, held until this context manager ends.

    Beside each file, `.NAME.lock` is locked by the operating system, which releases the lock when the process ends, in
    whatever way. What a killed process leaves is therefore harmless, and the next command removes it. On network file
    systems such locks hold for all machines.

    Nothing waits for a lock, so no two commands can wait for each other. Commands that lock the same first file never
    refuse each other both.
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: set[Path] = set()

    def hold(self, paths: Iterable[Path]) -> None:
        """Lock files, whether they exist or not; those that are locked already stay so.

        Raises:
            RunError: another process holds one of them, or a lock cannot be made, for example where nothing may be
                written, or where its name is that of another file; the message says which.
        """
        for path in paths:
            # All names of a file, links to it too, have one lock.
            real = Path(os.path.realpath(path))
            place = real.with_name(f".{real.name}.lock")
            if place in self._held:
                continue
            _refuse_other_file(path, place)
            lock = FileLock(place, timeout=PATIENCE, on_acquired=_mark)
            try:
                self.enter_context(lock)
            except Timeout:
                _refuse_unwritable(path, place)
                raise RunError(f"{path} is being written by {_holder(place)}") from None
            except OSError as error:
                raise _unlockable(path, place, error) from None
            self._held.add(place)
            # Before the lock is released: whoever then gets a lock on the removed file sees that it is gone.
            self.callback(place.unlink, missing_ok=True)


def is_name_of_a_lock(path: Path) -> bool:
    """Return whether a file has a name that locks have."""
    name = os.path.basename(os.path.realpath(path))
    return name.startswith(".") and name.endswith(".lock")


def _refuse_other_file(path: Path, place: Path) -> None:
    """Refuse to take a file of somebody for a lock, which is emptied and removed.

    Raises:
        RunError: naming the file.
    """
    try:
        is_ours = place.is_file() and not place.is_symlink() and CONTENT.fullmatch(place.read_bytes())
        is_other = os.path.lexists(place) and not is_ours
    except OSError:
        # What makes the lock says why it cannot.
        return
    if is_other:
        raise RunError(f"{place} is not a lock of {PROGRAM}, and has the name of that of {path}: rename it")


def _mark(descriptor: int) -> None:
    """Write who holds a lock into its file. On a full disk the lock is as good without it."""
    since = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    command = shlex.join([PROGRAM, *sys.argv[1:]])[:LONGEST]
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        holder = f"process {os.getpid()} on {socket.gethostname()} since {since}: {command}"
        # The command may name files whose names are no text.
        os.write(descriptor, holder.encode("utf-8", "surrogateescape"))


def _refuse_unwritable(path: Path, place: Path) -> None:
    """Refuse a file for whose lock nobody can make a file, which `FileLock` takes for one that somebody has removed.

    Raises:
        RunError: naming the file.
    """
    try:
        os.close(os.open(place, os.O_RDWR | os.O_CREAT))
    except OSError as error:
        raise _unlockable(path, place, error) from None


def _unlockable(path: Path, place: Path, error: OSError) -> RunError:
    reason = error.strerror or str(error)
    return RunError(
        f"{path} cannot be written, since its lock {place} cannot be made: {reason}. Name a file in a directory where "
        "files can be made"
    )


def _holder(place: Path) -> str:
    """Who holds a lock, in words."""
    with suppress(OSError), open_regular(place) as file:
        return file.read(LONGEST_HOLDER).decode("utf-8", "surrogateescape") or "another process"
    return "another process"
