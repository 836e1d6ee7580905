"""Trajectories in two formats that survive a run being cut off at any moment."""

import errno
import io
import math
import os
import struct
import tempfile
from abc import abstractmethod
from pathlib import Path
from typing import Any

from openmm import app
from openmm.unit import Quantity

from openmm_sier.cli.files.records import CHANGING, GrowingFile, Noted, naming

#: Length of OpenMM's header of a DCD file, bytes, and the place of the time in it, which is left out so that equal runs
#: have equal files.
DCD_HEADER, DCD_TIME = 276, slice(180, 260)

#: Beginning of that header: the length of its first record, and the format.
DCD_MAGIC = struct.pack("<i4s", 84, b"CORD")

#: Places in that header: whether frames have a box, and the number of atoms.
DCD_HAS_BOX, DCD_ATOMS = slice(48, 52), slice(268, 272)

#: Beginning of a frame of an XTC file, and the length of its header, bytes. The last four bytes are the length of the
#: compressed positions. Positions of few atoms are not compressed, and have a shorter header.
XTC_MAGIC, XTC_HEADER = (1995).to_bytes(4, "big"), 92
XTC_FEW_ATOMS, XTC_FEW_HEADER = 9, 56

#: Place of the number of a frame, and the number of the first one.
XTC_NUMBER = slice(8, 12)
XTC_FIRST = (1).to_bytes(4, "big")


class Trajectory(GrowingFile):
    """Frames of a file that grows."""

    def __init__(self, path: Path, topology: app.Topology, dt: float, interval: int, noted: Noted | None):
        """Begin a file with atoms of a topology, steps of dt ps and an interval in steps, or continue it."""
        super().__init__(path, noted)
        self._topology = topology
        self._dt = dt
        self._interval = interval

    @abstractmethod
    def write(self, positions: Quantity, box: Quantity) -> None:
        """Append a frame of positions (n, 3) in nm, and periodic box vectors (a Quantity) or None."""


class DCDTrajectory(Trajectory):
    """Frames of a DCD file, all of the same length.

    OpenMM formats header and frames in memory. The first part of the header, which counts the frames, is written after
    each frame.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._memory = io.BytesIO()
        app.DCDFile(self._memory, self._topology, self._dt, self._interval, self._interval)
        with self._memory.getbuffer() as header:
            header[8:12] = struct.pack("<i", self.count)
            header[DCD_TIME] = bytes(DCD_TIME.stop - DCD_TIME.start)
        # A file that is appended to has its number of frames from the header.
        self._dcd = app.DCDFile(self._memory, self._topology, self._dt, self._interval, self._interval, append=True)
        if self.size:
            self.replace_beginning(self._memory.getvalue()[:CHANGING])
        else:
            self.append(self._memory.getvalue(), counts=False)

    @staticmethod
    def records_after(path: Path, size: int) -> int:
        header, end = _header_and_length(path, DCD_HEADER)
        return math.ceil((end - max(size, DCD_HEADER)) / _dcd_frame(header))

    @staticmethod
    def are_records(path: Path, size: int) -> bool:
        header, end = _header_and_length(path, DCD_HEADER)
        if not DCD_HEADER <= size <= end or not header.startswith(DCD_MAGIC):
            return False
        frame = _dcd_frame(header)
        return frame > 0 and (size - DCD_HEADER) % frame == 0

    @staticmethod
    def is_beginning(path: Path) -> bool:
        header, end = _header_and_length(path, DCD_HEADER)
        # The magic may have been cut off too.
        return end <= DCD_HEADER and (header.startswith(DCD_MAGIC) or DCD_MAGIC.startswith(header))

    def write(self, positions: Quantity, box: Quantity) -> None:
        self._dcd.writeModel(positions, periodicBoxVectors=box)
        everything = self._memory.getvalue()
        self._memory.truncate(DCD_HEADER)
        self.append(everything[DCD_HEADER:])
        self.replace_beginning(everything[:CHANGING])


class XTCTrajectory(Trajectory):
    """Frames of an XTC file, which follow each other without a header."""

    @staticmethod
    def records_after(path: Path, size: int) -> int:
        count = 0
        with naming(path), open(path, "rb") as file:
            end = file.seek(0, os.SEEK_END)
            while size < end:
                file.seek(size)
                length = _frame_length(file.read(XTC_HEADER))
                size = end if length is None else size + length
                count += 1
        return count

    @staticmethod
    def are_records(path: Path, size: int) -> bool:
        header, end = _header_and_length(path, XTC_HEADER)
        # Where no frame is noted, the first one may have been cut off.
        if not (XTC_MAGIC.startswith(header[:4]) and XTC_FIRST.startswith(header[XTC_NUMBER])):
            return False
        least = _frame_length(header) if size else 0
        return least is not None and least <= size <= end

    @staticmethod
    def is_beginning(path: Path) -> bool:
        return path.stat().st_size == 0

    def write(self, positions: Quantity, box: Quantity) -> None:
        with tempfile.TemporaryDirectory() as directory:
            frame = Path(directory) / "frame.xtc"
            # Steps have 32 bits, which long runs exceed: frames are counted in their place, and times are right.
            file = app.XTCFile(str(frame), self._topology, self._dt * self._interval, self.count + 1)
            file.writeModel(positions, periodicBoxVectors=box)
            # OpenMM's writer raises no error if the temporary directory is full.
            if not _is_frame(frame, len(positions)):
                place = f"OpenMM left it incomplete in the temporary directory {tempfile.gettempdir()}"
                message = f"a frame could not be written: {place}. Is its disk full? Set TMPDIR to another directory"
                raise OSError(errno.EIO, message, str(self.path))
            self.append(frame.read_bytes())


def _header_and_length(path: Path, length: int) -> tuple[bytes, int]:
    """Return at most `length` bytes from the beginning of a file, and the length of the file."""
    with naming(path), open(path, "rb") as file:
        return file.read(length), file.seek(0, os.SEEK_END)


def _dcd_frame(header: bytes) -> int:
    """Return the length of a frame of a DCD file with this header."""
    (has_box,), (atoms,) = (struct.unpack("<i", header[place]) for place in (DCD_HAS_BOX, DCD_ATOMS))
    # Each record of Fortran has its length before and after it: the box, then x, y and z.
    length: int = (48 + 8) * has_box + 3 * (4 * atoms + 8)
    return length


def _frame_length(header: bytes) -> int | None:
    """Return the length of an XTC frame that begins with these bytes; None if they are no whole header."""
    if len(header) < XTC_FEW_HEADER or header[:4] != XTC_MAGIC:
        return None
    atoms, compressed = (int.from_bytes(header[first : first + 4], "big") for first in (4, XTC_HEADER - 4))
    if atoms <= XTC_FEW_ATOMS:
        return XTC_FEW_HEADER + 12 * atoms
    if len(header) < XTC_HEADER:
        return None
    # Padded to whole words of four bytes.
    return XTC_HEADER + 4 * math.ceil(compressed / 4)


def _is_frame(path: Path, atoms: int) -> bool:
    """Return whether an XTC file has one complete frame with this number of atoms."""
    import mdtraj

    try:
        with mdtraj.formats.XTCTrajectoryFile(str(path)) as file:
            return file.read()[0].shape == (1, atoms, 3)
    # MDTraj has errors of several kinds for files that are cut off.
    except Exception:
        return False


#: Formats by the endings of names, in lower case.
FORMATS: dict[str, type[Trajectory]] = {".dcd": DCDTrajectory, ".xtc": XTCTrajectory}
