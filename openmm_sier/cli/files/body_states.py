"""The file of body states of a run, which stays readable after a crash."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm

from openmm_sier.cli.files import records
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.observe.body_states import (
    BodyStateFile,
    body_frame,
    check_same,
    frame_type,
    import_h5py,
    read_frames,
)

SUFFIX = ".h5"

#: Bytes converted at a time.
CHUNK_BYTES = 2**24


class BodyStates(records.MadeAtTheEnd):
    """An HDF5 file in the layout of `openmm_sier.observe.body_states`, whose centres follow continuous paths.

    It is made of a file of frames alone. Both hold every bit of the numbers, so a finished file can be turned back into
    frames and continued.
    """

    GROWING = ".frames"

    def __init__(
        self, path: Path, bodies: RigidBodies, periodic: bool, run: str = "", noted: records.Noted | None = None
    ):
        """
        Args:
            path: of the HDF5 file.
            bodies: the rigid bodies.
            periodic: whether there is a box.
            run: identity of the run.
            noted: what to keep of the frames; None begins anew.

        Raises:
            ValueError: the file to continue has another layout, or holds other bodies.
        """
        self.target, self._bodies, self._periodic, self._title = path, bodies, periodic, records.title(run)
        self._frame = frame_type(bodies.n, periodic)
        self._chunk = max(1, CHUNK_BYTES // self._frame.itemsize)
        if noted and not self.unfinished(path):
            self._take_apart()
        super().__init__(self.growing(path), noted)

    @classmethod
    def check(cls, path: Path, noted: records.Noted, run: str) -> None:
        if cls.unfinished(path):
            super().check(cls.growing(path), noted, run)
            return
        with records.naming(path), import_h5py().File(path, "r") as file:
            if file.attrs.get("title") != records.title(run) or len(file["step"]) < noted.count:
                raise records.RecordError(f"{path} is not the file that the checkpoint belongs to")

    def write(self, context: openmm.Context) -> None:
        """Append the bodies of a Context at its last completed step."""
        self.append(body_frame(context, context.getState()).tobytes())

    def _make(self, path: Path) -> None:
        frames = np.memmap(self.path, self._frame, "r") if self.count else np.zeros(0, self._frame)
        file = BodyStateFile(path, self._bodies, self._periodic, title=self._title)
        try:
            for first in range(0, self.count, self._chunk):
                file.append(frames[first : first + self._chunk])
        finally:
            file.close()

    def _take_apart(self) -> None:
        with (
            import_h5py().File(self.target, "r") as file,
            records.replacing(self.growing(self.target)) as made,
            open(made, "wb") as out,
        ):
            check_same(file, self.target, self._bodies, self._periodic)
            for first in range(0, len(file["step"]), self._chunk):
                out.write(read_frames(file, first, first + self._chunk).tobytes())


def check_possible(path: Path) -> None:
    """Check that body states can be written: the name of their file, and the packages that it needs.

    Raises:
        RecordError: the name does not end in .h5.
        ModuleNotFoundError: h5py is missing.
    """
    if path.suffix != SUFFIX:
        raise records.RecordError(f"body states go to a file that ends in {SUFFIX}, got {path.name}")
    import_h5py()
