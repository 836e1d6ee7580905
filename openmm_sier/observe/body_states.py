"""Self-describing HDF5 files of the bodies' phase points. Requires the extra h5py.

Datasets over frames T and bodies n: step (T,), time (T,), q (T, n, 3), quaternion (T, n, 4), p (T, n, 3), L (T, n, 3),
heat (T,) and, with periodic boundaries, box (T, 3, 3), whose rows are the box vectors. Over bodies: species (n,),
masses (n,) and moments (n, 3). For each species K a group species_K with atoms (m, k), the particle indices of its m
bodies of k atoms, masses (k,), sites (k, 3) in the frame of the body, principal moments (3,), and axes (3, 3), whose
rows are the principal axes in the frame of the body. This frame is that of the `BodyType`, whose name is the attribute
`type` of the group, about the centre of mass; without a type it is that of the principal axes. With names of bodies
also name (n,), empty for bodies without one. Attributes of the root are the conventions and units (`CONVENTIONS`), and
`wrapped`: whether centres are wrapped into the box.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.index_ranges import as_ranges
from openmm_sier.observe import conservation
from openmm_sier.system.body_selection import SelectedBodies
from openmm_sier.system.boxes import wrapped

if TYPE_CHECKING:
    import h5py

#: Attributes of the root, except `wrapped`.
CONVENTIONS = {
    "layout": 2,
    "program": "openmm_sier",
    "frame": "lab: q, p and L have components along the axes of the laboratory",
    "quaternion": "(w, x, y, z), w >= 0, of the rotation R that turns the frame of a body into the lab frame: an atom "
    "is at q + R r, where r is its site in that frame; R is A^T axes, with the attitude matrix A",
    "angular_momentum": "about the centre of mass of the body",
    "bodies": "in the order in which they were listed, then those that constraints form, then points: body i is of "
    "species[i]; the bodies of species K are the rows of species_K/atoms in this order",
    "units": "time in ps; q, box and sites in nm; masses in dalton; moments in dalton nm^2; p in dalton nm/ps; L in "
    "dalton nm^2/ps; heat in kJ/mol",
}

#: Names of bodies with their particle indices.
Names = SelectedBodies | Mapping[str, Sequence[int]] | None

#: Numbers per chunk, 64 kB.
CHUNK = 8192


def body_frame(context: openmm.Context, state: openmm.State, unwrapped: bool = True) -> dict[str, np.ndarray]:
    """Return the bodies of a Context at its last completed step, by the names of the datasets over frames.

    Args:
        context: a Context with an integrator of this package or an `OpenMMIntegrator`.
        state: a State of the Context.
        unwrapped: whether centres follow continuous paths, as in the Context, or are wrapped into the box.

    Raises:
        TypeError: the Context has another integrator.
    """
    integrator = conservation.sier_integrator(context)
    motion = integrator.getBodyState()
    datasets: dict[str, ArrayLike] = {
        "step": state.getStepCount(),
        "time": state.getTime().value_in_unit(unit.picosecond),
        "q": motion.q.T,
        "quaternion": integrator.bodies.orientations(motion),
        "p": motion.p.T,
        "L": motion.L.T,
        "heat": integrator.countedHeat,
    }
    if context.getSystem().usesPeriodicBoundaryConditions():
        box = state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        datasets["box"] = box
        if not unwrapped:
            datasets["q"] = wrapped(motion.q.T, box)
    return {name: np.asarray(values) for name, values in datasets.items()}


def names_of(bodies: BodySet, names: Names) -> list[str]:
    """Return the name of each body, empty for unnamed bodies.

    Args:
        bodies: the bodies.
        names: see `Names`; virtual sites may be among the particles.

    Raises:
        ValueError: the particles of a name are not exactly one body.
    """
    labels = [""] * bodies.n
    if names is None:
        return labels
    pairs = zip(names.names, names.atoms, strict=True) if isinstance(names, SelectedBodies) else names.items()
    for name, particles in pairs:
        atoms = np.asarray(list(particles), dtype=np.int64)
        inside = atoms[(atoms >= 0) & (atoms < bodies.n_particles)]
        numbers = sorted(set(bodies.owners[inside].tolist()) - {-1})
        is_whole = len(numbers) == 1 and len(inside) == len(atoms) and np.isin(bodies.atoms_of(numbers[0]), atoms).all()
        if not is_whole:
            raise ValueError(
                f"names must belong to whole bodies, but {name!r} has atoms {as_ranges(atoms)}, which are not one body "
                f"of {bodies!r}"
            )
        labels[numbers[0]] = name
    return labels


def begin(
    file: h5py.File, bodies: BodySet, frame: Mapping[str, np.ndarray], unwrapped: bool, names: Names = None
) -> None:
    """Describe the bodies in an empty file, or check that a file can be continued with these bodies.

    Args:
        file: file open for writing.
        bodies: the bodies of the frames.
        frame: the first frame to be appended.
        unwrapped: see `body_frame`.
        names: names of bodies; a continued file keeps its names.

    Raises:
        ValueError: the file has another layout, wrapping or other bodies; or names do not belong to whole bodies.
    """
    named = names_of(bodies, names)
    conventions = CONVENTIONS | {"wrapped": "no" if unwrapped or "box" not in frame else "into the box"}
    if not len(file):
        file.attrs.update(conventions)
        for name, values in _constants(bodies).items():
            file[name] = values
        for number, species in enumerate(bodies.species):
            if species.name:
                file[f"species_{number}"].attrs["type"] = species.name
        if any(named):
            # Bytes of UTF-8, which every HDF5 reader accepts as text.
            file["name"] = [name.encode() for name in named]
        for name, values in frame.items():
            # There may be no bodies, but chunks must not be empty.
            most = [max(1, size) for size in values.shape]
            growing = {"maxshape": (None, *most), "chunks": (max(1, CHUNK // math.prod(most)), *most)}
            file.create_dataset(name, (0, *values.shape), values.dtype, **growing)
    for name, expected in conventions.items():
        if (present := file.attrs.get(name)) != expected:
            raise ValueError(f"{name} is {present}, expected {expected}")
    if not np.array_equal(file["masses"], bodies.masses) or not np.array_equal(file["moments"], bodies.moments.T):
        raise ValueError(f"its {len(file['masses'])} bodies are not the bodies of this System")


def append(file: h5py.File, frame: Mapping[str, np.ndarray]) -> None:
    """Write and flush a frame, so that the file is readable after a kill; only the last frame may be damaged."""
    for name, values in frame.items():
        file[name].resize(len(file[name]) + 1, axis=0)
        file[name][-1] = values
    file.flush()


def _constants(bodies: BodySet) -> dict[str, np.ndarray]:
    """Return datasets that are the same for all frames, by name."""
    kinds = np.empty(bodies.n, dtype=np.int64)
    for number, columns in enumerate(bodies.columns):
        kinds[columns] = number
    datasets = {
        "species": kinds,
        "masses": bodies.masses,
        "moments": bodies.moments.T,
    }
    for number, species in enumerate(bodies.species):
        arrays = {
            "atoms": species.atoms,
            "masses": species.masses,
            "sites": species.sites.T @ species.axes,
            "moments": species.moments,
            "axes": species.axes,
        }
        datasets |= {f"species_{number}/{name}": values for name, values in arrays.items()}
    return datasets
