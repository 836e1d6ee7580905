"""Locks on the files that a command writes, so that no other writes them at the same time."""

from __future__ import annotations

import errno
import json
import os
import shlex
import socket
import sys
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from datetime import datetime, timezone
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from openmm_sier.cli.plan import RunError
from openmm_sier.cli.streams import PROGRAM

#: Seconds to wait for a lock: for one whose holder is just ending, not for a run.
PATIENCE = 0.2

#: What a file system answers that has no locks.
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP}

#: Characters of a command in a message.
LONGEST = 200


class FileLocks(ExitStack):
    """Locks on files, held until this context manager ends.

    Beside each file, `.NAME.lock` is locked by the operating system, which releases the lock when the process ends, in
    whatever way. What a killed process leaves is therefore harmless, and the next command removes it. On network file
    systems such locks hold for all machines. Where there are none, the existence of `.NAME.held` is the lock; if its
    process was killed on another machine, it has to be removed by hand, as the message says.

    Nothing waits for a lock, so no two commands can wait for each other. Commands that lock the same first file never
    refuse each other both.
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: dict[Path, BaseFileLock] = {}

    def hold(self, paths: Iterable[Path]) -> None:
        """Lock files, whether they exist or not; those that are locked already stay so.

        Raises:
            RunError: another process holds one of them; the message says which. All locks stay as they were.
            OSError: a lock cannot be made.
        """
        with ExitStack() as taken:
            for path in paths:
                for place in _places(path):
                    if place not in self._held:
                        taken.callback(self._release, place)
                        self._held[place] = _locked(place, path)
            self.push(taken.pop_all())

    def remove(self) -> None:
        """Remove the files of the locks, from any thread, before the process is ended at once."""
        for place in list(self._held):
            with suppress(OSError):
                place.unlink()

    def _release(self, place: Path) -> None:
        lock = self._held.pop(place, None)
        if lock is None:
            return
        # Before the lock is released: whoever then gets a lock on the removed file sees that it is gone.
        if not isinstance(lock, SoftFileLock):
            with suppress(OSError):
                place.unlink()
        lock.release()


def _places(path: Path) -> list[Path]:
    """Where the locks of a file lie: beside its name and, if that is a symbolic link, beside what it leads to."""
    names = {Path(os.path.realpath(path.parent), path.name), Path(os.path.realpath(path))}
    return sorted(name.with_name(f".{name.name}.lock") for name in names if name.parent.is_dir())


def _locked(place: Path, path: Path) -> BaseFileLock:
    """A lock that this process holds; the file at `place` then says who that is."""

    def mark(descriptor: int) -> None:
        # On a full disk the lock is as good without it.
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, json.dumps(_this_process()).encode())

    # It finds a file that its last holder removed while it was being opened, and takes a new one.
    lock = FileLock(place, timeout=PATIENCE, on_acquired=mark)
    try:
        lock.acquire()
    except Timeout:
        raise RunError(f"{path} is being written by {_holder(place)}") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise OSError(error.errno, f"cannot be locked: {error.strerror}", str(path)) from error
        return _locked_by_existence(place, path)
    return lock


def _locked_by_existence(place: Path, path: Path) -> BaseFileLock:
    """A lock where the operating system has none."""
    if place.stat().st_size:
        # It has answered otherwise before.
        raise RunError(f"{path} is being written by {_holder(place)}. If that has ended, remove {place}")
    place.unlink(missing_ok=True)
    place = place.with_suffix(".held")
    lock = SoftFileLock(place, timeout=PATIENCE)
    try:
        lock.acquire()
    except Timeout:
        by = f"process {lock.pid}" if lock.pid else "another process"
        raise RunError(f"{path} is being written by {by}. If that has ended, remove {place}") from None
    return lock


def _this_process() -> dict[str, str | int]:
    command = shlex.join([PROGRAM, *sys.argv[1:]])
    since = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    return {"process": os.getpid(), "host": socket.gethostname(), "since": since, "command": command[:LONGEST]}


def _holder(place: Path) -> str:
    """Who holds a lock, in words."""
    try:
        who = json.loads(place.read_text())
        return f"process {who['process']} on {who['host']} since {who['since']}: {who['command']}"
    except (OSError, ValueError, TypeError, KeyError):
        return f"another process, which holds {place}"
