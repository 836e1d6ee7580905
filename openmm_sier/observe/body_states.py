"""Self-describing HDF5 files of the bodies' phase points. Needs h5py and scipy, an extra.

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
from numpy.typing import ArrayLike

from openmm_sier.dynamics.bodies import BodyState, RigidBodies

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

#: Values of the attribute `wrapped` of q.
CONTINUOUS, WRAPPED = "no", "into the box"


def frame_shapes(n: int, periodic: bool) -> dict[str, tuple[int, ...]]:
    """Shapes of what a frame of n bodies holds, by dataset."""
    shapes: dict[str, tuple[int, ...]] = {"step": (), "time": (), "q": (n, 3), "quaternion": (n, 4), "p": (n, 3)}
    return shapes | {"L": (n, 3), "heat": ()} | ({"box": (3, 3)} if periodic else {})


def body_frame_values(
    step: int, time: float, motion: BodyState, box: np.ndarray | None = None, unwrapped: bool = True
) -> dict[str, Any]:
    """The contents of a frame by dataset.

    Args:
        step: number of the step.
        time: ps.
        motion: the bodies' phase point.
        box: box vectors as rows, (3, 3), nm; None without periodic boundaries.
        unwrapped: centres as they are in the Context, along continuous paths; otherwise their images in the box.
    """
    _, Rotation = import_extras()
    turns = Rotation.from_matrix(motion.A.transpose(2, 1, 0))
    values = {
        "step": step,
        "time": time,
        "q": motion.q.T if unwrapped or box is None else wrapped(motion.q.T, box),
        "quaternion": turns.as_quat(canonical=True, scalar_first=True),
        "p": motion.p.T,
        "L": motion.L.T,
        "heat": motion.heat,
    }
    return values if box is None else values | {"box": np.asarray(box, dtype=float)}


def create_datasets(file: h5py.File, bodies: RigidBodies, periodic: bool, unwrapped: bool = True) -> None:
    """Put empty datasets over frames, and all that does not change, into an open, empty HDF5 file."""
    for name, shape in frame_shapes(bodies.n, periodic).items():
        frames = max(1, CHUNK // max(1, int(np.prod(shape))))
        kind = "i8" if name == "step" else "f8"
        dataset = file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=(frames, *shape))
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
    return CONTINUOUS if unwrapped or not periodic else WRAPPED


def _constant(group: h5py.Group, name: str, values: ArrayLike, unit: str) -> None:
    group[name] = values
    group[name].attrs["unit"] = unit


class BodyStateFile:
    """An HDF5 file that grows one frame at a time.

    Every frame is flushed, so that the file of a run that was killed can be read; the last frame may be damaged.
    """

    def __init__(
        self, path: str | Path, bodies: RigidBodies, periodic: bool, unwrapped: bool = True, append: bool = False
    ) -> None:
        """
        Args:
            path: of the HDF5 file.
            bodies: the bodies whose states are written.
            periodic: whether there is a box.
            unwrapped: see `body_frame_values`.
            append: continue after the last frame of an existing file, instead of replacing it.

        Raises:
            ModuleNotFoundError: h5py or scipy is missing.
            ValueError: the file to be continued has another layout or wrapping, or is of other bodies.
        """
        h5py, _ = import_extras()
        self._periodic, self._unwrapped = periodic, unwrapped
        # The oldest file format does not mark files as open for writing; the mark would lock readers out after a kill.
        self._file = h5py.File(path, "r+" if append else "w", libver="earliest")
        if append:
            try:
                check_same(self._file, Path(path), bodies, periodic, unwrapped)
            except BaseException:
                self._file.close()
                raise
        else:
            create_datasets(self._file, bodies, periodic, unwrapped)
        self._count = len(self._file["step"])
        self._file.flush()

    def write(self, step: int, time: float, motion: BodyState, box: np.ndarray | None = None) -> None:
        """Append a frame, and flush it; the arguments are those of `body_frame_values`."""
        values = body_frame_values(step, time, motion, box if self._periodic else None, self._unwrapped)
        self._count += 1
        for name, value in values.items():
            dataset = self._file[name]
            dataset.resize(self._count, axis=0)
            dataset[-1] = value
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def check_same(file: h5py.File, path: Path, bodies: RigidBodies, periodic: bool, unwrapped: bool = True) -> None:
    """Refuse a file to which frames of these bodies cannot be appended.

    Raises:
        ValueError: the file has another layout or wrapping, or is of other bodies.
    """
    layout = file.attrs.get("layout")
    if layout != LAYOUT:
        raise ValueError(f"{path} cannot be continued: it has body states in layout {layout}, expected {LAYOUT}")
    if not np.array_equal(file["masses"], bodies.masses) or not np.array_equal(file["moments"], bodies.moments.T):
        raise ValueError(f"{path} cannot be continued: its {len(file['masses'])} bodies are not those of this System")
    wrapping = _wrapping(periodic, unwrapped)
    if (there := file["q"].attrs["wrapped"]) != wrapping:
        raise ValueError(f"{path} cannot be continued: its centres are wrapped: {there}, expected: {wrapping}")


def import_extras() -> tuple[Any, Any]:
    """The module h5py and the class scipy.spatial.transform.Rotation.

    Raises:
        ModuleNotFoundError: one of them is missing.
    """
    try:
        import h5py
        from scipy.spatial.transform import Rotation
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("body states need h5py and scipy: pip install 'openmm-sier[hdf5]'") from error
    return h5py, Rotation


def wrapped(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Points (n, 3) moved by box vectors into the box.

    Args:
        points: (n, 3), nm.
        box: box vectors as rows, in OpenMM's reduced form, (3, 3), nm.
    """
    moved, box = np.array(points, dtype=float), np.asarray(box, dtype=float)
    for axis in (2, 1, 0):
        moved -= np.outer(np.floor(moved[:, axis] / box[axis, axis]), box[axis])
    return moved
