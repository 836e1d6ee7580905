"""Files that survive a run being cut off at any moment: log, checkpoint, and all that grows by records.

Trajectory and log only grow, by one write for each frame or row. The checkpoint notes their lengths, and is replaced as
a whole. After a crash they are cut back to these lengths, and the run goes on from the checkpoint, with no gap and no
frame twice. So that no file of another run is cut, the checkpoint also notes a fingerprint of what each of them held.
"""

from __future__ import annotations

import hashlib
import os
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openmm_sier.observe.conservation import csv_line

#: Bytes at the beginning and at the end of what a file held at a checkpoint by which it is known again.
WINDOW = 2**16


class RecordError(ValueError):
    """A file of a run is missing or damaged, or belongs to another run."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Make errors of the operating system name this file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def temporary(path: Path) -> Path:
    """Temporary path of a file that takes its place when it is complete."""
    return path.with_name(f"{path.name}.tmp")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path, of which what is written there takes the place of a file at the end.

    At any moment, after a power failure too, the file is the old or the new one. After an error it is the old one, and
    nothing of the new one is left.
    """
    made = temporary(path)
    with naming(path):
        try:
            yield made
            with open(made, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(made, path)
        except BaseException:
            made.unlink(missing_ok=True)
            raise


def title(run: str) -> str:
    """Title of a file by the identity of its run."""
    return f"openmm-sier run {run}"


@dataclass(frozen=True)
class Noted:
    """What a checkpoint notes of a file that grows.

    Attributes:
        size: bytes written.
        count: records among them, a header not counted.
        fingerprint: of these bytes, see `GrowingFile.fingerprint`.
    """

    size: int
    count: int
    fingerprint: str


class GrowingFile:
    """A file that only grows, by whole records.

    Attributes:
        path: of the file.
        size: bytes written.
        count: records written, a header not counted.
    """

    #: Bytes at the beginning that change while the file grows.
    CHANGING = 0

    def __init__(self, path: Path, noted: Noted | None = None):
        """
        Args:
            path: of the file.
            noted: what to keep of an existing file, for which `check` has passed; the rest is cut off. Without it, the
                file is made anew.

        Raises:
            OSError: it cannot be written.
        """
        self.path = path
        self.size, self.count = (noted.size, noted.count) if noted else (0, 0)
        with naming(path):
            self._file = open(path, "r+b" if self.size else "wb", buffering=0)  # noqa: SIM115
            self._file.truncate(self.size)
            self._file.seek(self.size)

    @classmethod
    def check(cls, path: Path, noted: Noted, run: str) -> None:
        """Check that an output is the one that a checkpoint belongs to, so that a cut at its noted size ends a record.

        Args:
            path: of the output.
            noted: of it by the checkpoint.
            run: identity of the run by the checkpoint.

        Raises:
            RecordError: the output is missing, has fewer bytes than noted, or other ones.
        """
        if not noted.size:
            return
        if not path.exists():
            raise RecordError(f"{path} is missing; a restart continues the file that its checkpoint belongs to")
        if (size := path.stat().st_size) < noted.size:
            raise RecordError(f"{path} has {size} bytes, fewer than the {noted.size} that it had at the checkpoint")
        if cls.fingerprint(path, noted.size) != noted.fingerprint:
            raise RecordError(
                f"{path} is not the file that the checkpoint belongs to, or was edited: its first {noted.size} bytes "
                "are not those of the checkpoint"
            )

    @staticmethod
    def companions(path: Path) -> list[Path]:
        """Further files that are written along with the output at this path."""
        return []

    @classmethod
    def unfinished(cls, path: Path) -> bool:
        """Whether something is left to be done for the output at this path at the end of its run."""
        return not path.exists()

    def append(self, record: bytes, counts: bool = True) -> None:
        """Write a record.

        Raises:
            OSError: for example, the disk is full. The file then ends with the previous record.
        """
        with naming(self.path):
            try:
                # One system call, so that a kill nearly always leaves whole records; cutting back mends the rest.
                written = self._file.write(record)
                # A disk that is nearly full takes a part of the record, and refuses only the next write.
                while written < len(record):
                    written += self._file.write(record[written:])
            except OSError:
                with suppress(OSError):
                    self._file.truncate(self.size)
                    self._file.seek(self.size)
                raise
        self.size += len(record)
        self.count += counts

    def replace_beginning(self, value: bytes) -> None:
        """Write the bytes that change while the file grows."""
        with naming(self.path):
            self._file.seek(0)
            self._file.write(value)
            self._file.seek(self.size)

    def sync(self) -> None:
        """Wait until all bytes are on the disk."""
        with naming(self.path):
            os.fsync(self._file.fileno())

    def noted(self) -> Noted:
        """What a checkpoint notes of this file."""
        return Noted(self.size, self.count, self.fingerprint(self.path, self.size))

    def close(self) -> None:
        self._file.close()

    def finish(self) -> None:
        """Close the file at the end of its run."""
        self.close()

    @classmethod
    def fingerprint(cls, path: Path, size: int) -> str:
        """A digest of the first and the last bytes of a file, which takes no longer for a long one.

        Runs that differ in anything differ there: in the title of the trajectory, and in the last row of the log.

        Args:
            path: of the file.
            size: the bytes from this one on are left out, as are those that change while the file grows.

        Raises:
            OSError: it cannot be read.
        """
        digest = hashlib.blake2b(digest_size=16)
        with naming(path), open(path, "rb") as file:
            for first, last in ((cls.CHANGING, cls.CHANGING + WINDOW), (max(cls.CHANGING, size - WINDOW), size)):
                file.seek(first)
                digest.update(file.read(max(0, min(last, size) - first)))
        return digest.hexdigest()


class MadeAtTheEnd(GrowingFile):
    """An output that is made of another, growing file at the end of a run.

    An HDF5 file that is cut off while being written is lost, so the frames are kept in a file beside it until the run
    ends. As long as that file is there, it is what counts, also where a kill came just before its removal.

    Attributes:
        target: path of the output.
    """

    #: Appended to the name of the output, this is the name of the growing file.
    GROWING = ""

    target: Path

    @classmethod
    def growing(cls, path: Path) -> Path:
        """Path of the growing file for the output at a path."""
        return path.with_name(path.name + cls.GROWING)

    @classmethod
    def companions(cls, path: Path) -> list[Path]:
        return [cls.growing(path), temporary(path)]

    @classmethod
    def unfinished(cls, path: Path) -> bool:
        return cls.growing(path).exists() or super().unfinished(path)

    @classmethod
    def check(cls, path: Path, noted: Noted, run: str) -> None:
        if not path.exists() or cls.growing(path).exists():
            super().check(cls.growing(path), noted, run)
            return
        found, count = cls.read_finished(path)
        if found != title(run):
            raise RecordError(f"{path} is not the file that the checkpoint belongs to: its title is {found}")
        if count < noted.count:
            raise RecordError(f"{path} has {count} frames, fewer than the {noted.count} that it had at the checkpoint")

    @classmethod
    @abstractmethod
    def read_finished(cls, path: Path) -> tuple[str, int]:
        """Title and number of frames of an output that has been made.

        Raises:
            RecordError: it is no such file.
        """

    @abstractmethod
    def _make(self, path: Path) -> None:
        """Write the output to a path."""

    def finish(self) -> None:
        """Make the output and remove the growing file.

        Raises:
            RecordError: the output could not be written. The growing file stays.
        """
        super().finish()
        try:
            with replacing(self.target) as made:
                self._make(made)
        # PyTables and h5py raise RuntimeErrors of their own where the disk is full.
        except (OSError, RuntimeError) as error:
            reason = " ".join(str(error).split())[-200:]
            message = f"{self.target} could not be written: {reason}. Its frames are kept in {self.path}"
            raise RecordError(message) from error
        self.path.unlink()


class Log(GrowingFile):
    """A CSV file of numbers with a heading."""

    def __init__(self, path: Path, columns: Sequence[str], noted: Noted | None = None):
        super().__init__(path, noted)
        self.columns = tuple(columns)
        if not self.size:
            self.append(csv_line(self.columns).encode(), counts=False)

    def write(self, values: Sequence[float]) -> None:
        self.append(csv_line(values).encode())


def read_log(path: Path) -> dict[str, np.ndarray]:
    """All rows of a `Log`, by column.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path) as file:
        columns = file.readline().rstrip().split(",")
        rows = np.loadtxt(file, delimiter=",", ndmin=2).reshape(-1, len(columns))
    return dict(zip(columns, rows.T, strict=True))
