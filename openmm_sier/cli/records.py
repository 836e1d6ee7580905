"""Files that survive a run being cut off at any moment: trajectory, log and checkpoint.

Trajectory and log only grow, by one write for each frame or row. The checkpoint notes their lengths, and is replaced as
a whole. After a crash they are cut back to these lengths, and the run goes on from the checkpoint, with no gap and no
frame twice.
"""

from __future__ import annotations

import io
import json
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app
from openmm.unit import Quantity

from openmm_sier.cli.notes import check_notes

#: Version of what a checkpoint holds.
FORMAT = 2

#: The largest step number that DCD and XTC files hold. In longer runs a DCD file keeps this number, and an XTC file
#: counts frames instead, so that its times stay right.
LARGEST_STEP = 2**31 - 1

#: The second title in OpenMM's header of a DCD file, the time at which it was made. It is left blank, so that the same
#: run gives the same bytes.
DCD_DATE = slice(180, 260)

#: Frames converted at a time.
CHUNK = 100


class RecordError(ValueError):
    """A file of a run is missing or damaged, or belongs to another run."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Make errors of the operating system name this file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


class GrowingFile:
    """A file that only grows, by whole records.

    Attributes:
        path: of the file.
        size: bytes written.
        count: records written, a header not counted.
    """

    def __init__(self, path: Path, size: int = 0, count: int = 0):
        """
        Args:
            path: of the file.
            size: bytes to keep of an existing file; the rest is cut off. With 0 the file is made anew.
            count: records among the bytes kept.

        Raises:
            RecordError: the file is missing, or has fewer bytes than `size`.
            OSError: it cannot be written.
        """
        self.path, self.size, self.count = path, size, count
        if size:
            if not path.exists():
                raise RecordError(f"{path} is missing; a restart continues the file that its checkpoint belongs to")
            there = path.stat().st_size
            if there < size:
                raise RecordError(f"{path} has {there} bytes, fewer than the {size} that it had at the checkpoint")
        with naming(path):
            self._file = open(path, "r+b" if size else "wb", buffering=0)  # noqa: SIM115
            self._file.truncate(size)
            self._file.seek(size)

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

    def patch(self, offset: int, value: bytes) -> None:
        with naming(self.path):
            self._file.seek(offset)
            self._file.write(value)
            self._file.seek(self.size)

    def sync(self) -> None:
        """Wait until all bytes are on the disk."""
        with naming(self.path):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def length(self) -> dict[str, int]:
        """The entries of the checkpoint for this file."""
        return {"size": self.size, "count": self.count}

    @staticmethod
    def companions(path: Path) -> list[Path]:
        """Further files that are written along with the file at this path."""
        return []


class Log(GrowingFile):
    """A CSV file of numbers with a heading."""

    def __init__(self, path: Path, columns: Sequence[str], size: int = 0, count: int = 0):
        super().__init__(path, size, count)
        self.columns = tuple(columns)
        if not size:
            self.append((",".join(self.columns) + "\n").encode(), counts=False)

    def write(self, values: Sequence[float]) -> None:
        self.append((",".join(f"{value:.12g}" for value in values) + "\n").encode())

    def read(self) -> dict[str, np.ndarray]:
        """All rows, by column."""
        return read_log(self.path)


def read_log(path: Path) -> dict[str, np.ndarray]:
    """All rows of a `Log`, by column.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path) as file:
        columns = file.readline().rstrip().split(",")
        rows = np.loadtxt(file, delimiter=",", ndmin=2).reshape(-1, len(columns))
    return dict(zip(columns, rows.T, strict=True))


class DCDTrajectory(GrowingFile):
    """Frames of a DCD file, all of the same length.

    OpenMM formats the frames; the number of frames in the header is raised after a frame has been written.
    """

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, size: int = 0, count: int = 0
    ) -> None:
        """
        Args:
            path: of the file.
            topology: openmm.app.Topology of the atoms that are written.
            dt: step, ps.
            interval: steps between frames.
            size: bytes of the file to keep.
            count: frames in these bytes.
        """
        super().__init__(path, size, count)
        self._topology, self._dt, self._interval = topology, dt, interval
        if size:
            self._patch_header()

    def write(self, positions: Quantity, box: Quantity) -> None:
        """Append a frame.

        Args:
            positions: (n, 3), nm.
            box: periodic box vectors (a Quantity) or None.
        """
        buffer = io.BytesIO()
        file = app.DCDFile(buffer, self._topology, self._dt, self._interval, self._interval)
        header = buffer.tell()
        file.writeModel(positions, periodicBoxVectors=box)
        if not self.size:
            buffer.getbuffer()[DCD_DATE] = bytes(DCD_DATE.stop - DCD_DATE.start)
            self.append(buffer.getvalue()[:header], counts=False)
        self.append(buffer.getvalue()[header:])
        self._patch_header()

    def _patch_header(self) -> None:
        self.patch(8, struct.pack("<i", self.count))
        self.patch(20, struct.pack("<i", min(self.count * self._interval, LARGEST_STEP)))

    def finish(self) -> None:
        self.close()


class XTCTrajectory(GrowingFile):
    """Frames of an XTC file, which follow each other without a header."""

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, size: int = 0, count: int = 0
    ) -> None:
        super().__init__(path, size, count)
        self._topology, self._dt, self._interval = topology, dt, interval

    def write(self, positions: Quantity, box: Quantity) -> None:
        with tempfile.TemporaryDirectory() as directory:
            frame = Path(directory) / "frame.xtc"
            step, dt = (self.count + 1) * self._interval, self._dt
            if step > LARGEST_STEP:
                step, dt = self.count + 1, self._dt * self._interval
            app.XTCFile(str(frame), self._topology, dt, step).writeModel(positions, periodicBoxVectors=box)
            self.append(frame.read_bytes())

    def finish(self) -> None:
        self.close()


class HDF5Trajectory(DCDTrajectory):
    """An HDF5 file in MDTraj's layout.

    An HDF5 file that is cut off while being written is lost, so the frames are kept in a DCD file beside it until the
    run ends.
    """

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, size: int = 0, count: int = 0
    ) -> None:
        self.target = path
        if size and path.exists():
            raise RecordError(f"{path} is complete; an .h5 trajectory can only be continued where its run was cut off")
        super().__init__(path.with_name(path.name + ".dcd"), topology, dt, interval, size, count)

    @staticmethod
    def companions(path: Path) -> list[Path]:
        return [path.with_name(path.name + ".dcd"), unfinished(path)]

    def finish(self) -> None:
        """Move the frames to the HDF5 file and remove the temporary one."""
        self.close()
        convert(self.path, self.target, self._write_frames)

    def _write_frames(self, path: Path) -> None:
        import mdtraj

        with mdtraj.formats.HDF5TrajectoryFile(str(path), "w", force_overwrite=True) as file:
            file.topology = mdtraj.Topology.from_openmm(self._topology)
            for first in range(0, self.count, CHUNK):
                positions, lengths, angles = self._read(first, min(CHUNK, self.count - first))
                steps = (np.arange(len(positions)) + first + 1) * self._interval
                file.write(coordinates=positions, time=steps * self._dt, cell_lengths=lengths, cell_angles=angles)

    def _read(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Positions of some frames in nm, and lengths (nm) and angles (degrees) of the box, None without one."""
        mark, n = "<i4", self._topology.getNumAtoms()
        record = [("x0", mark), ("x", "<f4", n), ("x1", mark), ("y0", mark), ("y", "<f4", n), ("y1", mark)]
        record += [("z0", mark), ("z", "<f4", n), ("z1", mark)]
        periodic = self._topology.getPeriodicBoxVectors() is not None
        frame = np.dtype([("box0", mark), ("box", "<f8", 6), ("box1", mark), *record] if periodic else record)
        start = self.size + (first - self.count) * frame.itemsize
        frames = np.fromfile(self.path, frame, count, offset=start)
        positions = np.stack([frames[axis] for axis in "xyz"], axis=-1) / 10
        if not periodic:
            return positions, None, None
        a, cos_gamma, b, cos_beta, cos_alpha, c = frames["box"].T
        angles = np.degrees(np.arccos([cos_alpha, cos_beta, cos_gamma]))
        return positions, np.transpose([a, b, c]) / 10, angles.T


def unfinished(path: Path) -> Path:
    """Temporary path of an HDF5 file, which is moved to its place when it is complete."""
    return path.with_name(f"unfinished-{path.name}")


def convert(growing: Path, target: Path, write: Callable[[Path], None]) -> None:
    """Make an HDF5 file from the frames of another file, which is then removed.

    Args:
        growing: holds the frames.
        target: the HDF5 file.
        write: writes the frames to a path.

    Raises:
        RecordError: the file could not be written. The frames stay where they were.
    """
    temporary = unfinished(target)
    try:
        write(temporary)
        os.replace(temporary, target)
    # PyTables and h5py raise RuntimeErrors of their own where the disk is full.
    except (OSError, RuntimeError) as error:
        temporary.unlink(missing_ok=True)
        reason = " ".join(str(error).split())[-200:]
        raise RecordError(f"{target} could not be written: {reason}. Its frames are kept in {growing}") from error
    growing.unlink()


FORMATS: dict[str, type[DCDTrajectory] | type[XTCTrajectory]] = {
    ".dcd": DCDTrajectory,
    ".xtc": XTCTrajectory,
    ".h5": HDF5Trajectory,
}


def trajectory_format(path: Path) -> type[DCDTrajectory] | type[XTCTrajectory]:
    """The class for a file name.

    Raises:
        RecordError: the ending is unknown, or a package that it needs is missing.
    """
    if path.suffix not in FORMATS:
        raise RecordError(f"a trajectory ends in {', '.join(FORMATS)}, got {path.name}")
    if path.suffix == ".h5" and find_spec("tables") is None:
        raise RecordError("an .h5 trajectory needs PyTables; install it with: pip install tables")
    return FORMATS[path.suffix]


def temporary_checkpoint(path: Path) -> Path:
    """Temporary path of a checkpoint, which replaces the last one when it is complete."""
    return path.with_name(path.name + ".tmp")


def write_checkpoint(path: Path, state: openmm.State, notes: dict[str, Any]) -> None:
    """Replace the checkpoint: at any moment the file is either the old or the new one.

    Args:
        path: of the file, a zip archive with state.xml and notes.json.
        state: openmm.State with positions, velocities and parameters.
        notes: what JSON can hold.

    Raises:
        OSError: it cannot be written. The old one is still there, and nothing of the new one.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("state.xml", openmm.XmlSerializer.serialize(state))
        archive.writestr("notes.json", json.dumps({"format": FORMAT, **notes}, indent=1))
    temporary = temporary_checkpoint(path)
    with naming(path):
        try:
            with open(temporary, "wb") as file:
                file.write(content.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


def read_checkpoint(path: Path) -> tuple[Any, dict[str, Any]]:
    """State and notes of a checkpoint.

    Raises:
        RecordError: the file is no checkpoint of this command.
        OptionError: its notes are not what they must be.
        FileNotFoundError: there is no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            state = openmm.XmlSerializer.deserialize(archive.read("state.xml").decode())
            notes = json.loads(archive.read("notes.json"))
            if not isinstance(notes, dict):
                raise ValueError("the notes have no names")
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, zlib.error, openmm.OpenMMException) as error:
        raise RecordError(f"{path} is no checkpoint of openmm-sier run") from error
    if notes.get("format") != FORMAT:
        raise RecordError(f"{path} was written by another version of openmm-sier, in format {notes.get('format')}")
    check_notes(path, notes)
    return state, notes
