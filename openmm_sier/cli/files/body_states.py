"""The file of body states of a run, which stays readable after a crash."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import openmm

from openmm_sier.cli.files import records
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.observe.body_states import BodyStateFile, body_frame, frame_type, import_h5py, read_frames

#: Frames converted at a time.
CHUNK = 100

#: Endings of the names of files of body states.
ENDINGS = (".h5", ".hdf5")


class BodyStates(records.GrowingFile):
    """An HDF5 file in the layout of `openmm_sier.observe.body_states`, whose centres follow continuous paths.

    An HDF5 file that is cut off while being written is lost, so it is made at the end of a run, of a file of frames
    beside it. As long as that is there, it is what counts, also where a kill came just before its removal. Both hold
    every bit of the numbers, so a finished file can be turned back into frames and continued.
    """

    def __init__(self, path: Path, bodies: RigidBodies, periodic: bool, noted: records.Noted | None = None):
        """
        Args:
            path: of the HDF5 file.
            bodies: the rigid bodies.
            periodic: whether there is a box.
            noted: what to keep of the frames; None begins anew.
        """
        super().__init__(self.growing(path), noted)
        self.target, self._bodies, self._periodic = path, bodies, periodic

    @classmethod
    def growing(cls, path: Path) -> Path:
        return path.with_name(f"{path.name}.frames")

    @classmethod
    def unfinished(cls, path: Path) -> bool:
        return cls.growing(path).exists() or super().unfinished(path)

    @classmethod
    def check(cls, path: Path, noted: records.Noted) -> None:
        growing = cls.growing(path)
        if cls.unfinished(path):
            super().check(growing, noted)
            return
        _take_apart(path, growing)
        try:
            super().check(growing, noted)
        except records.RecordError as error:
            growing.unlink()
            raise records.RecordError(f"{path} is not the file that the checkpoint belongs to") from error

    def write(self, context: openmm.Context) -> None:
        """Append the bodies of a Context at its last completed step."""
        self.append(body_frame(context, context.getState()).tobytes())

    def _chunks(self) -> Iterator[np.ndarray]:
        """The frames so far, in parts."""
        kind = frame_type(self._bodies.n, self._periodic)
        frames = np.memmap(self.path, kind, "r") if self.count else np.zeros(0, kind)
        for first in range(0, self.count, CHUNK):
            yield frames[first : first + CHUNK]

    def _make(self, path: Path) -> None:
        file = BodyStateFile(path, self._bodies, self._periodic)
        try:
            for chunk in self._chunks():
                file.append(chunk)
        finally:
            file.close()

    def _check_made(self, path: Path) -> None:
        """Compare every frame of the file at a path: a full disk may leave a damaged one without a word.

        Raises:
            RecordError: a frame is missing or different.
        """
        found = 0
        try:
            with import_h5py().File(path, "r") as file:
                for chunk in self._chunks():
                    if read_frames(file, found, found + len(chunk)).tobytes() != chunk.tobytes():
                        break
                    found += len(chunk)
        # h5py has errors of many kinds and many lines for files that are cut off.
        except Exception as error:
            raise records.RecordError("it cannot be read back. Is the disk full?") from error
        if found != self.count:
            raise records.RecordError(f"only {found} of {self.count} frames can be read back. Is the disk full?")

    def finish(self) -> None:
        """Make the HDF5 file, read it back, and remove the file of frames.

        Raises:
            RecordError: it could not be written, or not be read back. The file of frames stays.
        """
        super().finish()
        try:
            with records.replacing(self.target) as made:
                self._make(made)
                self._check_made(made)
        # h5py has errors of many kinds for files that are cut off.
        except Exception as error:
            message = f"{self.target} could not be written. Its frames are kept in {self.path}: {error}"
            raise records.RecordError(message) from error
        self.path.unlink()


def _take_apart(path: Path, frames: Path) -> None:
    """Make the file of frames anew of which an HDF5 file was made."""
    with import_h5py().File(path, "r") as file, records.replacing(frames) as made, open(made, "wb") as out:
        for first in range(0, len(file["step"]), CHUNK):
            out.write(read_frames(file, first, first + CHUNK).tobytes())
