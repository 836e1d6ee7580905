"""Trajectories that survive a run being cut off at any moment, in three formats."""

from __future__ import annotations

import io
import struct
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from openmm import app
from openmm.unit import Quantity

from openmm_sier.cli.files.records import GrowingFile, MadeAtTheEnd, Noted, RecordError, title

#: The largest step number that XTC files hold. In longer runs they count frames instead, so that times stay right.
LARGEST_STEP = 2**31 - 1

#: Bytes of OpenMM's header of a DCD file, and its second title. OpenMM puts the time there, for which we put the
#: identity of the run, so that the same run gives the same bytes.
DCD_HEADER, DCD_TITLE = 276, slice(180, 260)

#: Frames converted at a time.
CHUNK = 100


class DCDTrajectory(GrowingFile):
    """Frames of a DCD file, all of the same length.

    OpenMM formats header and frames in memory. The first part of the header, which counts the frames, is written again
    after each of them.
    """

    CHANGING = 48

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, run: str = "", noted: Noted | None = None
    ) -> None:
        """
        Args:
            path: of the file.
            topology: openmm.app.Topology of the atoms that are written.
            dt: step, ps.
            interval: steps between frames.
            run: identity of the run.
            noted: what to keep of an existing file.
        """
        super().__init__(path, noted)
        self._topology, self._dt, self._interval = topology, dt, interval
        self._memory = io.BytesIO()
        app.DCDFile(self._memory, topology, dt, interval, interval)
        with self._memory.getbuffer() as header:
            header[8:12] = struct.pack("<i", self.count)
            header[DCD_TITLE] = title(run).encode().ljust(DCD_TITLE.stop - DCD_TITLE.start, b"\0")
        # A file that is appended to has its number of frames from the header.
        self._dcd = app.DCDFile(self._memory, topology, dt, interval, interval, append=True)
        if self.size:
            self.replace_beginning(self._memory.getvalue()[: self.CHANGING])
        else:
            self.append(self._memory.getvalue(), counts=False)

    def write(self, positions: Quantity, box: Quantity) -> None:
        """Append a frame.

        Args:
            positions: (n, 3), nm.
            box: periodic box vectors (a Quantity) or None.
        """
        self._dcd.writeModel(positions, periodicBoxVectors=box)
        everything = self._memory.getvalue()
        self._memory.truncate(DCD_HEADER)
        self.append(everything[DCD_HEADER:])
        self.replace_beginning(everything[: self.CHANGING])


class XTCTrajectory(GrowingFile):
    """Frames of an XTC file, which follow each other without a header."""

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, run: str = "", noted: Noted | None = None
    ) -> None:
        super().__init__(path, noted)
        self._topology, self._dt, self._interval = topology, dt, interval

    def write(self, positions: Quantity, box: Quantity) -> None:
        with tempfile.TemporaryDirectory() as directory:
            frame = Path(directory) / "frame.xtc"
            step, dt = (self.count + 1) * self._interval, self._dt
            if step > LARGEST_STEP:
                step, dt = self.count + 1, self._dt * self._interval
            app.XTCFile(str(frame), self._topology, dt, step).writeModel(positions, periodicBoxVectors=box)
            self.append(frame.read_bytes())


class HDF5Trajectory(MadeAtTheEnd, DCDTrajectory):
    """An HDF5 file in MDTraj's layout, whose frames are in a DCD file until the run ends."""

    GROWING = ".dcd"

    def __init__(
        self, path: Path, topology: app.Topology, dt: float, interval: int, run: str = "", noted: Noted | None = None
    ) -> None:
        """
        Raises:
            RecordError: the run is to go on, but its HDF5 file has been made.
        """
        if noted and not self.unfinished(path):
            raise RecordError(f"{path} is complete; an .h5 trajectory can only be continued where its run was cut off")
        super().__init__(self.growing(path), topology, dt, interval, run, noted)
        self.target, self._title = path, title(run)

    @classmethod
    def check_finished(cls, path: Path, noted: Noted, run: str) -> None:
        import tables

        try:
            with tables.open_file(path) as file:
                found = getattr(file.root._v_attrs, "title", None)
        except (OSError, RuntimeError) as error:
            raise RecordError(f"{path} is no HDF5 file of a trajectory") from error
        if found != title(run):
            raise RecordError(f"{path} is not the file that the checkpoint belongs to: its title is {found}")

    def _make(self, path: Path) -> None:
        import mdtraj

        with mdtraj.formats.HDF5TrajectoryFile(str(path), "w", force_overwrite=True) as file:
            file.topology = mdtraj.Topology.from_openmm(self._topology)
            for first in range(0, self.count, CHUNK):
                positions, lengths, angles = self._read(first, min(CHUNK, self.count - first))
                time = (np.arange(len(positions)) + first + 1) * self._interval * self._dt
                file.write(coordinates=positions, time=time, cell_lengths=lengths, cell_angles=angles)
            # The first frame brings one of MDTraj's.
            file.title = self._title

    def _read(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Positions of some frames in nm, and lengths (nm) and angles (degrees) of the box, None without one.

        MDTraj's reader writes lines of its own to standard output.
        """
        mark, n = "<i4", self._topology.getNumAtoms()
        record: list[tuple] = []
        for axis in "xyz":
            record += [(f"{axis}0", mark), (axis, "<f4", n), (f"{axis}1", mark)]
        periodic = self._topology.getPeriodicBoxVectors() is not None
        frame = np.dtype([("box0", mark), ("box", "<f8", 6), ("box1", mark), *record] if periodic else record)
        frames = np.fromfile(self.path, frame, count, offset=DCD_HEADER + first * frame.itemsize)
        positions = np.stack([frames[axis] for axis in "xyz"], axis=-1) / 10
        if not periodic:
            return positions, None, None
        a, cos_gamma, b, cos_beta, cos_alpha, c = frames["box"].T
        angles = np.degrees(np.arccos([cos_alpha, cos_beta, cos_gamma]))
        return positions, np.transpose([a, b, c]) / 10, angles.T


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
