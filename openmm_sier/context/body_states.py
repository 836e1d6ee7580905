"""Files of bodies' phase points: HDF5, readable after a kill, and able to go on. Needs h5py, an extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies

#: Version of the layout.
LAYOUT = 2

#: What the file says of itself, as attributes of its root.
CONVENTIONS = {
    "layout": LAYOUT,
    "program": "openmm_sier",
    "frame": "lab: all vectors have components along the axes of the laboratory, in OpenMM's units",
    "quaternion": "(w, x, y, z), w >= 0, of the rotation that turns the principal axes of a body into the lab frame: "
    "site = q + R(quaternion) r, where r is the site in the principal frame and R = A^T",
    "angular_momentum": "about the centre of mass of the body",
    "bodies": "numbered species by species: body i belongs to species[i]; its atoms are a row of species_K/atoms",
}

#: Datasets over frames: unit, and what follows the frame in the shape (n is the number of bodies).
PER_FRAME = {
    "step": ("1", ()),
    "time": ("ps", ()),
    "q": ("nm", ("n", 3)),
    "quaternion": ("1", ("n", 4)),
    "p": ("dalton nm/ps", ("n", 3)),
    "L": ("dalton nm^2/ps", ("n", 3)),
    "heat": ("kJ/mol", ()),
    "box": ("nm", (3, 3)),
}

#: Size of a chunk in numbers: 64 kB.
CHUNK = 8192


class BodyStateFile:
    """Phase points of rigid bodies, a frame at a time.

    Datasets over frames T and bodies n: step (T,), time (T,), q (T, n, 3), quaternion (T, n, 4), p (T, n, 3),
    L (T, n, 3), heat (T,) and, with periodic boundaries, box (T, 3, 3), whose rows are the box vectors. Over bodies:
    species (n,), masses (n,) and moments (n, 3). For each species K a group species_K with atoms (m, k), the particle
    indices of its m bodies of k atoms, masses (k,), sites (k, 3) in the principal frame, and moments (3,). Each dataset
    has its unit as an attribute, and the root has the conventions.

    Every frame is flushed, so that the file of a run that was killed can be read. A frame counts once its step is
    there, which is written last.
    """

    def __init__(self, path, bodies: RigidBodies, periodic: bool, unwrapped: bool = True, keep: int | None = None):
        """
        Args:
            path: of the HDF5 file.
            bodies: whose states follow.
            periodic: whether there is a box.
            unwrapped: centres are written as they stand in the Context, which are continuous paths; otherwise those
                images are written that lie in the box.
            keep: frames of an existing file to keep, those after them being cut off; None replaces the file.

        Raises:
            ModuleNotFoundError: h5py or scipy is missing.
            ValueError: the existing file has fewer frames than `keep`, or is of other bodies or another layout.
        """
        h5py, self._rotation = import_extras()
        self._bodies, self._periodic = bodies, periodic
        self._wrapped = "no" if unwrapped or not periodic else "into the box"
        self._names = [name for name in PER_FRAME if name != "box" or periodic]
        # The oldest file format marks no file as open for writing, which would keep readers out after a kill.
        self._file = h5py.File(path, "w" if keep is None else "r+", libver="earliest")
        try:
            self.count = 0
            if keep is None:
                self._create()
            else:
                self._resume(Path(path), keep)
        except BaseException:
            self._file.close()
            raise
        self._file.flush()

    def _create(self) -> None:
        for name in self._names:
            unit, shape = PER_FRAME[name]
            rest = tuple(self._bodies.n if isinstance(size, str) else size for size in shape)
            chunk = (max(1, CHUNK // max(1, int(np.prod(rest)))), *rest)
            dataset = self._file.create_dataset(
                name, (0, *rest), "i8" if name == "step" else "f8", maxshape=(None, *rest), chunks=chunk
            )
            dataset.attrs["unit"] = unit
        self._file.attrs.update(CONVENTIONS)
        self._file["q"].attrs["wrapped"] = self._wrapped
        self._describe_bodies()

    def _describe_bodies(self) -> None:
        bodies = self._bodies
        sizes = [len(species.atoms) for species in bodies.species]
        self._constant(self._file, "species", np.repeat(np.arange(len(sizes)), sizes), "1")
        self._constant(self._file, "masses", bodies.masses, "dalton")
        self._constant(self._file, "moments", bodies.moments.T, "dalton nm^2")
        for number, species in enumerate(bodies.species):
            group = self._file.create_group(f"species_{number}")
            self._constant(group, "atoms", species.atoms, "1")
            self._constant(group, "masses", species.masses, "dalton")
            self._constant(group, "sites", species.sites.T, "nm")
            self._constant(group, "moments", species.moments, "dalton nm^2")

    @staticmethod
    def _constant(group, name: str, values, unit: str) -> None:
        group[name] = values
        group[name].attrs["unit"] = unit

    def _resume(self, path: Path, keep: int) -> None:
        file, n = self._file, self._bodies.n
        if file.attrs.get("layout") != LAYOUT:
            raise ValueError(f"{path} has layout {file.attrs.get('layout')} of body states, expected {LAYOUT}")
        if file["q"].shape[1] != n or not np.array_equal(file["masses"], self._bodies.masses):
            raise ValueError(f"{path} has states of {file['q'].shape[1]} other bodies, expected the {n} of this System")
        if ("box" in file) != self._periodic:
            raise ValueError(f"{path} was written {'without' if self._periodic else 'with'} a periodic box")
        if file["q"].attrs["wrapped"] != self._wrapped:
            raise ValueError(f"{path} has centres wrapped: {file['q'].attrs['wrapped']}; asked for is {self._wrapped}")
        if len(file["step"]) < keep:
            raise ValueError(f"{path} has {len(file['step'])} frames, expected at least {keep}")
        for name in self._names:
            file[name].resize(keep, axis=0)
        self.count = keep

    def write(self, step: int, time: float, state: BodyState, box=None) -> None:
        """Append a frame, and flush it.

        Args:
            step: number of the step.
            time: ps.
            state: the bodies' phase point.
            box: box vectors as rows, (3, 3), nm; needed with periodic boundaries.
        """
        turns = self._rotation.from_matrix(state.A.transpose(2, 1, 0))
        frame = {
            "time": time,
            "q": state.q.T if self._wrapped == "no" else wrapped(state.q.T, box),
            "quaternion": turns.as_quat(canonical=True, scalar_first=True),
            "p": state.p.T,
            "L": state.L.T,
            "heat": state.heat,
            "step": step,
        }
        if self._periodic:
            frame = {"box": np.asarray(box, dtype=float), **frame}
        for name, value in frame.items():
            dataset = self._file[name]
            dataset.resize(self.count + 1, axis=0)
            dataset[self.count] = value
        self.count += 1
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def import_extras():
    try:
        import h5py
        from scipy.spatial.transform import Rotation
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("body states need h5py and scipy: pip install 'openmm-sier[hdf5]'") from error
    return h5py, Rotation


def wrapped(points, box) -> np.ndarray:
    """Points (n, 3) moved by box vectors into the box.

    Args:
        points: (n, 3), nm.
        box: box vectors as rows, in OpenMM's reduced form, (3, 3), nm.
    """
    moved, box = np.array(points, dtype=float), np.asarray(box, dtype=float)
    for axis in (2, 1, 0):
        moved -= np.outer(np.floor(moved[:, axis] / box[axis, axis]), box[axis])
    return moved
