"""The file of body states of a run, which stays readable after a crash."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import openmm
from openmm import unit

from openmm_sier.cli import records
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.observe.body_states import body_frame_values, check_same, create_datasets, frame_shapes, import_extras

SUFFIX = ".h5"

#: Bytes converted at a time.
CHUNK_BYTES = 2**24


class BodyStates(records.GrowingFile):
    """An HDF5 file in the layout of `openmm_sier.observe.body_states`, whose centres follow continuous paths.

    An HDF5 file that is cut off while being written is lost, so the frames are kept in a plain file beside it until
    the run ends. Both hold every bit of the numbers, so a finished file can be turned back into a plain one and
    continued.
    """

    def __init__(self, path: Path, bodies: RigidBodies, periodic: bool, size: int = 0, count: int = 0):
        """
        Args:
            path: of the HDF5 file.
            bodies: the rigid bodies.
            periodic: whether there is a box.
            size: bytes of the plain file to keep.
            count: frames in these bytes.

        Raises:
            RecordError: the file to continue is missing, or too short.
            ValueError: it has another layout, or holds other bodies.
        """
        self.target, self._bodies, self._periodic = path, bodies, periodic
        shapes = frame_shapes(bodies.n, periodic).items()
        self._frame = np.dtype([(name, "<i8" if name == "step" else "<f8", shape) for name, shape in shapes])
        self._chunk = max(1, CHUNK_BYTES // self._frame.itemsize)
        frames = self._growing(path)
        if size and path.exists() and not frames.exists():
            self._take_apart(frames)
        super().__init__(frames, size, count)
        if not size:
            path.unlink(missing_ok=True)

    def write(self, context: openmm.Context) -> None:
        """Append the bodies of a Context at its last completed step."""
        state = context.getState()
        box = np.array(state.getPeriodicBoxVectors().value_in_unit(unit.nanometer)) if self._periodic else None
        values = body_frame_values(
            state.getStepCount(),
            state.getTime().value_in_unit(unit.picosecond),
            context.getIntegrator().getBodyState(),
            box,
        )
        record = np.zeros((), self._frame)
        for name, value in values.items():
            record[name] = value
        self.append(record.tobytes())

    def finish(self) -> None:
        """Move the frames to the HDF5 file and remove the temporary one."""
        self.close()
        records.convert(self.path, self.target, self._write_frames)

    def _write_frames(self, path: Path) -> None:
        import h5py

        with h5py.File(path, "w", libver="earliest") as file:
            create_datasets(file, self._bodies, self._periodic)
            frames = np.memmap(self.path, self._frame, "r") if self.count else np.zeros(0, self._frame)
            for name in self._frame.names or ():
                file[name].resize(self.count, axis=0)
            for first in range(0, self.count, self._chunk):
                some = frames[first : first + self._chunk]
                for name in self._frame.names or ():
                    file[name][first : first + len(some)] = some[name]

    def _take_apart(self, frames: Path) -> None:
        import h5py

        temporary = records.unfinished(frames)
        with h5py.File(self.target, "r") as file, records.naming(frames), open(temporary, "wb") as out:
            check_same(file, self.target, self._bodies, self._periodic)
            for first in range(0, len(file["step"]), self._chunk):
                count = min(self._chunk, len(file["step"]) - first)
                some = np.zeros(count, self._frame)
                for name in self._frame.names or ():
                    some[name] = file[name][first : first + count]
                out.write(some.tobytes())
        os.replace(temporary, frames)

    @staticmethod
    def _growing(path: Path) -> Path:
        return path.with_name(path.name + ".frames")

    @staticmethod
    def companions(path: Path) -> list[Path]:
        frames = BodyStates._growing(path)
        return [frames, records.unfinished(path), records.unfinished(frames)]

    @staticmethod
    def check(path: Path) -> None:
        """Check that such a file can be written: its name, and the packages that it needs.

        Raises:
            RecordError: the name does not end in .h5.
            ModuleNotFoundError: h5py or scipy is missing.
        """
        if path.suffix != SUFFIX:
            raise records.RecordError(f"body states go to a file that ends in {SUFFIX}, got {path.name}")
        import_extras()
