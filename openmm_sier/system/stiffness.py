"""Which Force holds an atom most stiffly: found when a step has failed, by finite differences of each Force alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS
from openmm_sier.system.bonded_terms import WITHOUT_FORCES

#: Displacement in nm. Forces in single precision then give a stiffness of 1e6 kJ/mol/nm^2 to 0.1 %.
DISPLACEMENT = 1e-4

#: So many atoms are looked at.
MOST_ATOMS = 8


class Stiffness(NamedTuple):
    """The largest second derivative of one Force by the position of one atom.

    Attributes:
        frequency: angular, of the atom alone on that spring, 1/ps.
        strength: kJ/mol/nm^2.
        atom: particle index.
        force: name and class of the Force.
        group: its force group.
    """

    frequency: float
    strength: float
    atom: int
    force: str
    group: int

    def __str__(self) -> str:
        period = 2000 * math.pi / self.frequency
        return (
            f"the stiffest force on these atoms is {self.force} of force group {self.group}, with "
            f"{self.strength:.3g} kJ/mol/nm^2 on atom {self.atom}, which alone would have a period of {period:.3g} fs"
        )


def stiffest_force(context: openmm.Context, positions: np.ndarray, atoms: Sequence[int]) -> Stiffness | None:
    """The stiffest Force on some atoms, at positions (N, 3) in nm; None if no Force curves the energy.

    A second Context is made for it, and the given one is left alone.
    """
    system = openmm.XmlSerializer.clone(context.getSystem())
    masses, names = tables.masses(system), _one_group_each(system)
    other = openmm.Context(system, openmm.VerletIntegrator(0.001), context.getPlatform())
    other.setState(context.getState(parameters=True))
    found = []
    for atom in [i for i in atoms if masses[i] > 0][:MOST_ATOMS]:
        for group, (name, theirs) in enumerate(names):
            strength = _largest_curvature(other, positions, atom, group)
            if strength > 0:
                found.append(Stiffness(math.sqrt(strength / masses[atom]), strength, atom, name, theirs))
    return max(found, default=None)


def _one_group_each(system: openmm.System) -> list[tuple[str, int]]:
    """Give each Force that exerts forces a group of its own; returns their names and former groups."""
    names = []
    acting = [force for force in system.getForces() if not isinstance(force, WITHOUT_FORCES)]
    for group, force in enumerate(acting[:GROUPS]):
        kind, name = type(force).__name__, force.getName()
        names.append((kind if name == kind else f"{name} ({kind})", force.getForceGroup()))
        force.setForceGroup(group)
        if isinstance(force, openmm.NonbondedForce):
            force.setReciprocalSpaceForceGroup(group)
    return names


def _largest_curvature(context: openmm.Context, positions: np.ndarray, atom: int, group: int) -> float:
    """Largest eigenvalue of the second derivatives of a group's energy by an atom's position, kJ/mol/nm^2."""
    columns = []
    for axis in range(3):
        forces = []
        for sign in (1, -1):
            moved = positions.copy()
            moved[atom, axis] += sign * DISPLACEMENT
            context.setPositions(moved)
            context.computeVirtualSites()
            found = context.getState(forces=True, groups={group}).getForces(asNumpy=True)._value
            forces.append(found[atom].copy())
        columns.append((forces[1] - forces[0]) / (2 * DISPLACEMENT))
    curvature = np.array(columns)
    return float(np.linalg.eigvalsh((curvature + curvature.T) / 2)[-1]) if np.isfinite(curvature).all() else 0.0
