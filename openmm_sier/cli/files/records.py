"""Files that survive a run being cut off at any moment: log, checkpoint, and all that grows by records.

Trajectory and log only grow, by one write for each frame or row. The checkpoint notes their lengths, and is replaced as
a whole. After a crash they are cut to these lengths, and the run continues from the checkpoint, without a gap or a
repeated frame. The checkpoint also notes a fingerprint of their content, so that no file of another run is cut.
"""

import errno
import hashlib
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated

from pydantic import Field

from openmm_sier.observe.conservation import csv_line
from openmm_sier.system.untrusted_files import open_regular

#: Bytes at the end of the noted content by which a file is recognized. Different runs differ there, in the last row of
#: the log and in the last frame.
WINDOW = 2**16

#: Bytes at the beginning that change while a file grows: a DCD file counts its frames there.
CHANGING = 48

#: Number of bytes at the end of a log that contain its last row.
LAST_ROW = 2**13

#: A number of bytes or of records in a file.
Count = Annotated[int, Field(ge=0, lt=2**62)]


class RecordError(ValueError):
    """A file of a run is missing or damaged, or belongs to another run."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the name of a file to errors of the operating system."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def replace(path: Path, content: memoryview) -> None:
    """Replace the content of a file.

    At any moment, and after a power failure, the file is the old or the new one. After an error it is the old one, and
    nothing remains of the new one. A link stays, and leads to the new file. Permissions stay.
    """
    real = Path(os.path.realpath(path))
    # Not by `tempfile`, whose files only their owner may read.
    temporary = real.with_name(f".openmm-sier-{secrets.token_hex(8)}.tmp")
    with naming(path):
        # Mode x never opens an existing file.
        file = open(temporary, "xb")  # noqa: SIM115
        try:
            with file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            with suppress(FileNotFoundError):
                os.chmod(temporary, stat.S_IMODE(os.stat(real).st_mode))
            os.replace(temporary, real)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@dataclass(frozen=True)
class Noted:
    """Notes on a growing file in a checkpoint.

    Attributes:
        size: bytes written.
        count: records among them, a header not counted.
        fingerprint: of these bytes.
    """

    size: Count
    count: Count
    fingerprint: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]


class GrowingFile:
    """A file that only grows, by whole records.

    Attributes:
        magic: the first bytes of each file of this format.
        longest_beginning: upper bound of the number of bytes that a run writes before its first checkpoint.
        path: of the file.
        size: bytes written.
        count: records written, a header not counted.
    """

    magic: bytes
    longest_beginning: int

    def __init__(self, path: Path, noted: Noted | None = None):
        """
        Args:
            path: of the file.
            noted: content of an existing file that stays, which has passed `check`; the rest is cut off. None: the file
                is new.

        Raises:
            OSError: it cannot be written.
        """
        self.path = path
        self.size = noted.size if noted else 0
        self.count = noted.count if noted else 0
        with naming(path):
            self._file = open(path, "r+b" if self.size else "w+b", buffering=0)  # noqa: SIM115
            self._file.truncate(self.size)
            self._file.seek(self.size)

    def append(self, record: bytes, counts: bool = True) -> None:
        """Write a record. The restart cuts off an incomplete one.

        Raises:
            OSError: for example, the disk is full, or another program has changed the file.
        """
        written = 0
        with naming(self.path):
            self._check_length()
            while written < len(record):
                written += self._file.write(record[written:])
        self.size += len(record)
        self.count += counts

    def replace_beginning(self, value: bytes) -> None:
        """Write the bytes that change while the file grows."""
        with naming(self.path):
            self._file.seek(0)
            self._file.write(value)
            self._file.seek(self.size)

    def noted(self) -> Noted:
        """Return the notes on this file for a checkpoint, after all of it was written to the disk.

        Raises:
            OSError: it cannot be written, or another program has changed or replaced it.
        """
        with naming(self.path):
            os.fsync(self._file.fileno())
            self._check_length()
            if not os.path.samestat(os.fstat(self._file.fileno()), os.stat(self.path)):
                raise _changed_by_others("replaced")
            fingerprint = _fingerprint(self._file, self.size)
            self._file.seek(self.size)
        return Noted(self.size, self.count, fingerprint)

    def _check_length(self) -> None:
        """Refuse a file that another program has cut: writing would fill the gap with zeros."""
        if os.fstat(self._file.fileno()).st_size != self.size:
            raise _changed_by_others("changed")

    def close(self) -> None:
        """Close the file at the end of its run."""
        self._file.close()


def _changed_by_others(how: str) -> OSError:
    return OSError(errno.ESTALE, f"another program has {how} this file while the run writes it")


def check(path: Path, noted: Noted) -> None:
    """Check that an output is the one that a checkpoint belongs to, so that a cut at its noted size ends a record.

    Args:
        path: of the output.
        noted: of it by the checkpoint.

    Raises:
        RecordError: the output is missing, or does not begin with the noted bytes.
        OSError: it cannot be read.
    """
    if not os.path.exists(path):
        raise RecordError(
            f"{path}, which the run of this checkpoint writes, is missing: put it back under this name, or begin a new "
            "run from the checkpoint with --start"
        )
    with naming(path), open_regular(path) as file:
        is_same = os.fstat(file.fileno()).st_size >= noted.size and _fingerprint(file, noted.size) == noted.fingerprint
    if not is_same:
        raise RecordError(
            f"{path} was edited or replaced: its first {noted.size} bytes are not those that the checkpoint has noted. "
            "Put the old file back, or begin a new run from the checkpoint with --start"
        )


def is_beginning(path: Path, format: type[GrowingFile]) -> bool:
    """Return whether a file holds no more than a run writes before its first checkpoint."""
    first = _first_bytes(path, len(format.magic))
    # They may have been cut off too.
    return format.magic.startswith(first) and path.stat().st_size <= format.longest_beginning


def last_step(log: Path) -> int:
    """Return the step of the last complete row of a log.

    Raises:
        ValueError: there is none.
        OSError: it cannot be read.
    """
    with open(log, "rb") as file:
        file.seek(max(0, os.path.getsize(log) - LAST_ROW))
        lines = file.read().split(b"\n")
    if len(lines) < 2:
        raise ValueError(f"{log} has no complete row")
    return int(lines[-2].split(b",")[0])


def _first_bytes(path: Path, count: int) -> bytes:
    with naming(path), open_regular(path) as file:
        return file.read(count)


def _fingerprint(file: IO[bytes], size: int) -> str:
    """Return a digest of the last bytes of the first `size` bytes of an open file."""
    begin = max(CHANGING, size - WINDOW)
    file.seek(begin)
    return hashlib.blake2b(file.read(max(0, size - begin)), digest_size=16).hexdigest()


class Log(GrowingFile):
    """A CSV file of numbers with a heading."""

    magic = b"Step,Time (ps),"
    longest_beginning = 2**10

    def __init__(self, path: Path, columns: Sequence[str], noted: Noted | None):
        super().__init__(path, noted)
        self.columns = tuple(columns)
        if not self.size:
            self.append(csv_line(self.columns).encode(), counts=False)

    def write(self, values: Sequence[float]) -> None:
        self.append(csv_line(values).encode())
