"""Give bodies a mass and moments of inertia by adjusting the masses of their atoms.

A coarse-grained body has few beads, whose masses need not have the moments of the atoms they represent. The motion of a
body depends only on its mass, centre and moments, so any bead masses with these values will do. So kinetic energies,
random velocities and all integrators, including OpenMM's with frames, agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.index_ranges import as_ranges
from openmm_sier.dynamics.species import Species
from openmm_sier.system import tables
from openmm_sier.system.arguments import Positions, Quantity, checked_positions, checked_system, quantity_to_float
from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.cut_molecules import Wholeness

#: Minimum mass of an atom over the mean mass; a massless atom would be frozen.
LEAST = 1e-3

#: Relative tolerance of mass and moments.
ACCURACY = 1e-9

#: Axes of the products of inertia.
PAIRS = ((0, 1), (0, 2), (1, 2))

_MOMENT = unit.dalton * unit.nanometer**2


def set_inertia(
    system: openmm.System,
    positions: Positions,
    bodies: Sequence[Sequence[int]],
    mass: Quantity,
    moments: Sequence[Quantity] | Quantity,
) -> None:
    """Give bodies a mass and moments of inertia, by the masses of their atoms.

    Call this function before bodies are created and before `prepare_system`. Centres and principal axes of the bodies
    do not change. A `BodyType` with moments needs no such masses; with these OpenMM's integrators agree too.

    >>> set_inertia(system, positions, [range(24)], 500*dalton, [30, 40, 60])

    Args:
        system: the System, in which the masses of the bodies' atoms change.
        positions: positions of its particles, (N, 3), nm or a Quantity, with bodies whole.
        bodies: particle indices of each body, as returned by `select_bodies`. Virtual sites among them are left out.
        mass: mass of each body, a quantity or a number in dalton.
        moments: principal moments of each body, in ascending order, three quantities or numbers in dalton nm^2.

    Raises:
        TypeError: `system` is not a System, or a value is not a number.
        ValueError: moments are not in ascending order; the largest exceeds the sum of the others; no masses of the
            atoms have these moments; or the System already has a Context. The System is unchanged then.
        RigidityError: the periodic boundary cuts a body.
    """
    system = checked_system(system)
    refuse_bound(system)
    x = checked_positions(positions, system.getNumParticles())
    total = quantity_to_float("mass", mass, unit.dalton, "dalton")
    target = _checked_moments(moments)
    if total <= 0:
        raise ValueError(f"mass must be positive, got {total:g} dalton")
    present = tables.masses(system)
    clusters = [np.array([i for i in body if not system.isVirtualSite(int(i))], dtype=np.int64) for body in bodies]
    for body, atoms in zip(bodies, clusters, strict=True):
        if not len(atoms):
            got = f"only the virtual sites {as_ranges(body)}" if len(body) else "no atoms"
            raise ValueError(f"a body must consist of atoms with mass, got {got}")
        if not (present[atoms] > 0).all():
            massless = int(atoms[(present[atoms] > 0).argmin()])
            raise ValueError(
                f"a body must consist of atoms with mass, but atom {massless} of {_described(body)} has none. Give it "
                f"any mass first, as by system.setParticleMass({massless}, 1), which set_inertia replaces; or make it "
                "a virtual site of the others"
            )
    Wholeness(system).refuse_cut(x, [atoms[None] for atoms in clusters], _described)
    new_masses: dict[int, float] = {}
    for atoms in clusters:
        shape = Species.from_coordinates(atoms[None], present[atoms], x[atoms])
        masses = _masses(shape, total, target, _described(atoms))
        new_masses |= dict(zip(atoms.tolist(), masses.tolist(), strict=True))
    for atom, atom_mass in new_masses.items():
        system.setParticleMass(atom, atom_mass)


def _described(atoms: Any) -> str:
    return f"atoms {as_ranges(atoms)}"


def _checked_moments(moments: Any) -> np.ndarray:
    values = np.array([quantity_to_float("moments", value, _MOMENT, "dalton nm^2") for value in moments])
    if values.shape != (3,) or (np.diff(values) < 0).any() or values[0] < 0:
        raise ValueError(f"moments must be three nonnegative numbers in ascending order, got {values.tolist()}")
    if values[2] > values[0] + values[1] + ACCURACY * values[2]:
        raise ValueError(f"the largest of the moments must be at most the sum of the two others, got {values.tolist()}")
    return values


def _masses(shape: Species, mass: float, moments: np.ndarray, name: str) -> np.ndarray:
    """Return masses (k,) of a body's atoms with the given total mass and moments, and the same centre and axes.

    Raises:
        ValueError: there are none; the message contains `name`.
    """
    sites = shape.sites
    # In these units mass and moments are of the order of 1, and equations have equal weights.
    length = np.sqrt((sites**2).sum(axis=0).mean()) or 1.0
    r = sites / length
    squares = np.maximum(moments.sum() / 2 - moments, 0) / (mass * length**2)
    rows = np.vstack([np.ones(r.shape[1]), r, r**2, [r[i] * r[j] for i, j in PAIRS]])
    target = np.concatenate([[1.0], np.zeros(3), squares, np.zeros(3)])
    mean = 1 / r.shape[1]
    least = LEAST * mean
    # The least deviation from equal shares; where some of these are negative, any that are not.
    shares = mean + np.linalg.lstsq(rows, target - mean * rows.sum(axis=1), rcond=None)[0]
    if (shares < least).any():
        from scipy.optimize import nnls

        shares = least + nnls(rows, target - least * rows.sum(axis=1))[0]
    # A comparison with NaN is false.
    if not np.abs(rows @ shares - target).max() <= ACCURACY:
        raise ValueError(
            f"no masses give {name} the moments {', '.join(f'{moment:.4g}' for moment in moments)} dalton nm^2 about "
            "their centre and axes. Add particles without interactions to the body, further out for larger moments and "
            "at its centre for smaller ones"
        )
    return mass * shares
