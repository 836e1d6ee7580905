"""What laws read from Systems: energies and forces, and atoms of molecules and of bodies."""

from collections.abc import Sequence

import numpy as np
import openmm

from openmm_sier import RigidBodies
from tests.laws.mechanics import masses_of
from tests.support.waters import plain_context


def evaluated(system: openmm.System, x: np.ndarray, platform: str = "Reference") -> tuple[float, np.ndarray]:
    """Return the potential energy, kJ/mol, and the forces on particles with mass, (N, 3), kJ/mol/nm."""
    state = plain_context(system, x, platform).getState(energy=True, forces=True)
    forces = state.getForces(asNumpy=True)._value * (masses_of(system) > 0)[:, None]
    return state.getPotentialEnergy()._value, forces


def molecules_of(context: openmm.Context, named: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the atoms of each molecule; named bodies are parts of one."""
    found = [set(molecule) for molecule in context.getMolecules()]
    for body in map(set, named):
        joined = [molecule for molecule in found if molecule & body]
        found = [molecule for molecule in found if not molecule & body] + [set().union(*joined)]
    return [sorted(molecule) for molecule in found]


def rigid_atoms(system: openmm.System, bodies: RigidBodies) -> list[list[int]]:
    """Return the atoms with mass of each rigid body of several atoms."""
    masses = masses_of(system)
    massive = [[i for i in cluster if masses[i] > 0] for cluster in sorted(clusters(bodies))]
    return [atoms for atoms in massive if len(atoms) > 1]


def clusters(bodies: RigidBodies) -> set[tuple[int, ...]]:
    """Return the atoms of each body."""
    return {tuple(sorted(atoms)) for species in bodies.species for atoms in species.atoms.tolist()}
