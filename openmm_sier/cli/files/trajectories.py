"""Trajectories that survive a run being cut off at any moment."""

import io
import struct
from pathlib import Path

from openmm import app
from openmm.unit import Quantity

from openmm_sier.cli.files.records import CHANGING, GrowingFile, Noted

#: Length of OpenMM's header of a DCD file, bytes, and the place of the time in it, which is left out so that equal runs
#: have equal files.
HEADER, TIME = 276, slice(180, 260)


class Trajectory(GrowingFile):
    """Frames of a DCD file.

    OpenMM formats header and frames in memory. The first part of the header, which counts the frames, is written after
    each frame.
    """

    magic = struct.pack("<i4s", 84, b"CORD")
    longest_beginning = HEADER

    def __init__(self, path: Path, topology: app.Topology, dt: float, interval: int, noted: Noted | None):
        """Begin a file with atoms of a topology, steps of dt ps and an interval in steps, or continue it."""
        super().__init__(path, noted)
        self._memory = io.BytesIO()
        app.DCDFile(self._memory, topology, dt, interval, interval)
        with self._memory.getbuffer() as header:
            header[8:12] = struct.pack("<i", self.count)
            header[TIME] = bytes(TIME.stop - TIME.start)
        # A file that is appended to has its number of frames from the header.
        self._dcd = app.DCDFile(self._memory, topology, dt, interval, interval, append=True)
        if self.size:
            self.replace_beginning(self._memory.getvalue()[:CHANGING])
        else:
            self.append(self._memory.getvalue(), counts=False)

    def write(self, positions: Quantity, box: Quantity) -> None:
        """Append a frame of positions (n, 3) in nm, and periodic box vectors (a Quantity) or None."""
        self._dcd.writeModel(positions, periodicBoxVectors=box)
        everything = self._memory.getvalue()
        self._memory.truncate(HEADER)
        self.append(everything[HEADER:])
        self.replace_beginning(everything[:CHANGING])
