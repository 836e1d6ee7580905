"""Self-describing HDF5 files of the bodies' phase points. Needs h5py, an extra.

Datasets over frames T and bodies n: step (T,), time (T,), q (T, n, 3), quaternion (T, n, 4), p (T, n, 3), L (T, n, 3),
heat (T,) and, with periodic boundaries, box (T, 3, 3), whose rows are the box vectors. Over bodies: species (n,),
masses (n,) and moments (n, 3). For each species K a group species_K with atoms (m, k), the particle indices of its m
bodies of k atoms, masses (k,), sites (k, 3) in the principal frame, and moments (3,). Each dataset has its unit as an
attribute, the root has the conventions (`CONVENTIONS`), and q says whether its centres are wrapped into the box.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.observe import conservation
from openmm_sier.system.boxes import wrapped

if TYPE_CHECKING:
    import h5py

#: Version of the layout.
LAYOUT = 2

#: Attributes of the root.
CONVENTIONS = {
    "layout": LAYOUT,
    "program": "openmm_sier",
    "frame": "lab: q, p and L have components along the axes of the laboratory",
    "quaternion": "(w, x, y, z), w >= 0, of the rotation R that turns the principal axes of a body into the lab frame: "
    "an atom is at q + R r, where r is its site in the principal frame; R is the transpose of the attitude matrix A",
    "angular_momentum": "about the centre of mass of the body",
    "bodies": "numbered species by species: body i is of species[i]; its atoms are one row of species_K/atoms",
}

UNITS = {
    "step": "1",
    "time": "ps",
    "q": "nm",
    "quaternion": "1",
    "p": "dalton nm/ps",
    "L": "dalton nm^2/ps",
    "heat": "kJ/mol",
    "box": "nm",
}

#: Size of a chunk in numbers, 64 kB.
CHUNK = 8192


def frame_type(n: int, periodic: bool) -> np.dtype:
    """The numbers of one frame of n bodies; the names are those of the datasets."""
    fields: list[tuple] = [("step", "<i8"), ("time", "<f8"), ("q", "<f8", (n, 3)), ("quaternion", "<f8", (n, 4))]
    fields += [("p", "<f8", (n, 3)), ("L", "<f8", (n, 3)), ("heat", "<f8")]
    return np.dtype([*fields, ("box", "<f8", (3, 3))] if periodic else fields)


def body_frame(context: openmm.Context, state: openmm.State, unwrapped: bool = True) -> np.ndarray:
    """The bodies of a Context at its last completed step, (1,) of `frame_type`.

    Args:
        context: of an integrator of this package, or of a `StockIntegrator`.
        state: a State of it.
        unwrapped: centres as they are in the Context, along continuous paths; otherwise their images in the box.

    Raises:
        TypeError: the Context has another integrator.
    """
    motion = conservation.sier_integrator(context).getBodyState()
    periodic = context.getSystem().usesPeriodicBoundaryConditions()
    frame = np.zeros(1, frame_type(motion.q.shape[1], periodic))
    frame["step"] = state.getStepCount()
    frame["time"] = state.getTime().value_in_unit(unit.picosecond)
    frame["q"], frame["p"], frame["L"], frame["heat"] = motion.q.T, motion.p.T, motion.L.T, motion.heat
    # SciPy, which MDTraj brings, is slow to import.
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(motion.A.transpose(2, 1, 0))
    frame["quaternion"] = turns.as_quat(canonical=True, scalar_first=True)
    if periodic:
        frame["box"] = state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        if not unwrapped:
            frame["q"] = wrapped(motion.q.T, frame["box"][0])
    return frame


def _create_datasets(file: h5py.File, bodies: RigidBodies, periodic: bool, unwrapped: bool) -> None:
    """Put empty datasets over frames, and all that does not change, into an open, empty HDF5 file."""
    for name, (kind, *_) in (frame_type(bodies.n, periodic).fields or {}).items():
        frames = max(1, CHUNK // max(1, int(np.prod(kind.shape))))
        size = {"shape": (0, *kind.shape), "maxshape": (None, *kind.shape), "chunks": (frames, *kind.shape)}
        dataset = file.create_dataset(name, dtype=kind.base, **size)
        dataset.attrs["unit"] = UNITS[name]
    file.attrs.update(CONVENTIONS)
    file["q"].attrs["wrapped"] = _wrapping(periodic, unwrapped)
    sizes = [len(species.atoms) for species in bodies.species]
    _constant(file, "species", np.repeat(np.arange(len(sizes)), sizes), "1")
    _constant(file, "masses", bodies.masses, "dalton")
    _constant(file, "moments", bodies.moments.T, "dalton nm^2")
    for number, species in enumerate(bodies.species):
        group = file.create_group(f"species_{number}")
        _constant(group, "atoms", species.atoms, "1")
        _constant(group, "masses", species.masses, "dalton")
        _constant(group, "sites", species.sites.T, "nm")
        _constant(group, "moments", species.moments, "dalton nm^2")


def _wrapping(periodic: bool, unwrapped: bool) -> str:
    return "no" if unwrapped or not periodic else "into the box"


def _constant(group: h5py.Group, name: str, values: ArrayLike, unit: str) -> None:
    group[name] = values
    group[name].attrs["unit"] = unit


class BodyStateFile:
    """An HDF5 file that grows by frames.

    What is written is flushed, so that the file of a run that was killed can be read; the last frame may be damaged.
    """

    def __init__(
        self, path: str | Path, bodies: RigidBodies, periodic: bool, unwrapped: bool = True, append: bool = False
    ) -> None:
        """
        Args:
            path: of the HDF5 file.
            bodies: the bodies whose states are written.
            periodic: whether there is a box.
            unwrapped: see `body_frame`.
            append: continue after the last frame of an existing file, instead of replacing it.

        Raises:
            ModuleNotFoundError: h5py is missing.
            ValueError: the file to be continued has another layout or wrapping, or is of other bodies.
        """
        h5py = import_h5py()
        # The oldest file format does not mark files as open for writing; the mark would lock readers out after a kill.
        self._file = h5py.File(path, "r+" if append else "w", libver="earliest")
        if append:
            try:
                self._check_same(bodies, _wrapping(periodic, unwrapped))
            except ValueError as error:
                self._file.close()
                raise ValueError(f"{path} cannot be continued: {error}") from None
        else:
            _create_datasets(self._file, bodies, periodic, unwrapped)
        self._file.flush()

    def _check_same(self, bodies: RigidBodies, wrapping: str) -> None:
        file = self._file
        if (layout := file.attrs.get("layout")) != LAYOUT:
            raise ValueError(f"it has body states in layout {layout}, expected {LAYOUT}")
        if not np.array_equal(file["masses"], bodies.masses) or not np.array_equal(file["moments"], bodies.moments.T):
            raise ValueError(f"its {len(file['masses'])} bodies are not those of this System")
        if (there := file["q"].attrs["wrapped"]) != wrapping:
            raise ValueError(f"its centres are wrapped: {there}, expected: {wrapping}")

    def append(self, frames: np.ndarray) -> None:
        """Write frames, (T,) of `frame_type`, and flush them."""
        count = len(self._file["step"])
        for name in frames.dtype.names or ():
            self._file[name].resize(count + len(frames), axis=0)
            self._file[name][count:] = frames[name]
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_frames(file: h5py.File, first: int, last: int) -> np.ndarray:
    """Frames of a file from one number up to another, (T,) of `frame_type`.

    Raises:
        KeyError: the file has no body states.
    """
    found = np.zeros(max(0, min(last, len(file["step"])) - first), frame_type(file["q"].shape[1], "box" in file))
    for name in found.dtype.names or ():
        found[name] = file[name][first:last]
    return found


def import_h5py() -> Any:
    """The module h5py.

    Raises:
        ModuleNotFoundError: it is missing.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("body states need h5py: pip install 'openmm-sier[hdf5]'") from error
    return h5py
