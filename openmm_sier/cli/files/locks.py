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

#: Seconds to wait for a lock whose holder is ending.
PATIENCE = 0.2

#: Characters of a command in a message.
LONGEST_COMMAND = 200

#: Largest number of bytes that are read of a lock file.
LONGEST_CONTENT = 2**12

#: Content of a lock file: nothing yet, or its holder.
CONTENT = re.compile(rb"(process \d+ on .* since \d{4}-\d\d-\d\d .*)?", re.DOTALL)


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
            RunError: another process holds one of them, or a lock cannot be made, for example without permission, or
                since another file has its name; the message names the file.
        """
        for path in paths:
            # All names of a file, including links, have one lock.
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
            # Before the lock is released: a process that then locks the removed file notices that it is gone.
            self.callback(place.unlink, missing_ok=True)


def is_name_of_a_lock(path: Path) -> bool:
    """Return whether a file has a name that locks have."""
    name = os.path.basename(os.path.realpath(path))
    return name.startswith(".") and name.endswith(".lock")


def _refuse_other_file(path: Path, place: Path) -> None:
    """Refuse to lock a file that is no lock file: locking empties and removes it.

    Raises:
        RunError: naming the file.
    """
    try:
        is_ours = place.is_file() and not place.is_symlink() and CONTENT.fullmatch(_content(place))
        is_other = os.path.lexists(place) and not is_ours
    except OSError:
        # There is none, or the lock cannot be made, which `FileLock` reports.
        return
    if is_other:
        raise RunError(f"{place} is not a lock of {PROGRAM}, but has the name of the lock of {path}: rename it")


def _mark(descriptor: int) -> None:
    """Write the holder of a lock into its file, unless the disk is full."""
    since = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    command = shlex.join([PROGRAM, *sys.argv[1:]])[:LONGEST_COMMAND]
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        holder = f"process {os.getpid()} on {socket.gethostname()} since {since}: {command}"
        # Names of files in the command may not be UTF-8.
        os.write(descriptor, holder.encode("utf-8", "surrogateescape"))


def _refuse_unwritable(path: Path, place: Path) -> None:
    """Refuse a file whose lock file cannot be created, for which `FileLock` waits.

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
    """Return the holder of a lock, in words."""
    with suppress(OSError):
        return _content(place).decode("utf-8", "surrogateescape") or "another process"
    return "another process"


def _content(place: Path) -> bytes:
    with open_regular(place) as file:
        return file.read(LONGEST_CONTENT)
