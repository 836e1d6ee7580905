"""Self-describing HDF5 files of the bodies' phase points. Needs h5py, an extra.

Datasets over frames T and bodies n: step (T,), time (T,), q (T, n, 3), quaternion (T, n, 4), p (T, n, 3), L (T, n, 3),
heat (T,) and, with periodic boundaries, box (T, 3, 3), whose rows are the box vectors. Over bodies: species (n,),
masses (n,) and moments (n, 3). For each species K a group species_K with atoms (m, k), the particle indices of its m
bodies of k atoms, masses (k,), sites (k, 3) in the principal frame, and moments (3,). Each dataset has its unit as an
attribute, the root has the conventions (`CONVENTIONS`), and q says whether its centres are wrapped into the box.
"""

from __future__ import annotations

from collections.abc import Mapping
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

#: Attributes of the root.
CONVENTIONS = {
    "layout": 2,
    "program": "openmm_sier",
    "frame": "lab: q, p and L have components along the axes of the laboratory",
    "quaternion": "(w, x, y, z), w >= 0, of the rotation R that turns the principal axes of a body into the lab frame: "
    "an atom is at q + R r, where r is its site in the principal frame; R is the transpose of the attitude matrix A",
    "angular_momentum": "about the centre of mass of the body",
    "bodies": "numbered species by species: body i is of species[i]; its atoms are one row of species_K/atoms",
}

#: Units of datasets by the last part of their names; numbers have the unit "1".
UNITS = {
    "time": "ps",
    "q": "nm",
    "p": "dalton nm/ps",
    "L": "dalton nm^2/ps",
    "heat": "kJ/mol",
    "box": "nm",
    "masses": "dalton",
    "moments": "dalton nm^2",
    "sites": "nm",
}

#: Size of a chunk in numbers, 64 kB.
CHUNK = 8192


def body_frame(context: openmm.Context, state: openmm.State, unwrapped: bool = True) -> dict[str, np.ndarray]:
    """The bodies of a Context at its last completed step, by the names of the datasets over frames.

    Args:
        context: of an integrator of this package, or of a `StockIntegrator`.
        state: a State of it.
        unwrapped: centres as they are in the Context, along continuous paths; otherwise their images in the box.

    Raises:
        TypeError: the Context has another integrator.
    """
    motion = conservation.sier_integrator(context).getBodyState()
    # SciPy, which MDTraj brings, is slow to import.
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(motion.A.transpose(2, 1, 0))
    found: dict[str, ArrayLike] = {
        "step": state.getStepCount(),
        "time": state.getTime().value_in_unit(unit.picosecond),
        "q": motion.q.T,
        "quaternion": turns.as_quat(canonical=True, scalar_first=True),
        "p": motion.p.T,
        "L": motion.L.T,
        "heat": motion.heat,
    }
    if context.getSystem().usesPeriodicBoundaryConditions():
        box = state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        found["box"] = box
        if not unwrapped:
            found["q"] = wrapped(motion.q.T, box)
    return {name: np.asarray(values) for name, values in found.items()}


def begin(file: h5py.File, bodies: RigidBodies, frame: Mapping[str, np.ndarray], unwrapped: bool) -> None:
    """Describe the bodies in an empty file, or check that a file with frames goes on with these.

    Args:
        file: open for writing.
        bodies: the bodies of the frames.
        frame: the first one that will be appended.
        unwrapped: see `body_frame`.

    Raises:
        ValueError: the file has another layout or wrapping, or is of other bodies.
    """
    wrapping = "no" if unwrapped or "box" not in frame else "into the box"
    constants = _constants(bodies)
    if not len(file):
        file.attrs.update(CONVENTIONS)
        for name, values in constants.items():
            _create(file, name, data=values)
        for name, values in frame.items():
            chunk = (max(1, CHUNK // values.size), *values.shape)
            shape = {"shape": (0, *values.shape), "maxshape": (None, *values.shape), "chunks": chunk}
            _create(file, name, dtype=values.dtype, **shape)
        file["q"].attrs["wrapped"] = wrapping
    if (layout := file.attrs.get("layout")) != CONVENTIONS["layout"]:
        raise ValueError(f"it has body states in layout {layout}, expected {CONVENTIONS['layout']}")
    if not all(np.array_equal(file[name], constants[name]) for name in ("masses", "moments")):
        raise ValueError(f"its {len(file['masses'])} bodies are not those of this System")
    if (there := file["q"].attrs["wrapped"]) != wrapping:
        raise ValueError(f"its centres are wrapped: {there}, expected: {wrapping}")


def append(file: h5py.File, frame: Mapping[str, np.ndarray]) -> None:
    """Write a frame, and flush it: the file of a run that was killed can be read; the last frame may be damaged."""
    for name, values in frame.items():
        file[name].resize(len(file[name]) + 1, axis=0)
        file[name][-1] = values
    file.flush()


def _constants(bodies: RigidBodies) -> dict[str, np.ndarray]:
    """What does not change, by the names of datasets."""
    sizes = [len(species.atoms) for species in bodies.species]
    found = {"species": np.repeat(np.arange(len(sizes)), sizes), "masses": bodies.masses, "moments": bodies.moments.T}
    for number, species in enumerate(bodies.species):
        parts = {"atoms": species.atoms, "masses": species.masses, "sites": species.sites.T, "moments": species.moments}
        found |= {f"species_{number}/{name}": values for name, values in parts.items()}
    return found


def _create(file: h5py.File, name: str, **options: Any) -> None:
    file.create_dataset(name, **options).attrs["unit"] = UNITS.get(name.split("/")[-1], "1")
