"""Which Force holds an atom most stiffly: found when a step has failed, by finite differences of each Force alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS
from openmm_sier.system.bonded_terms import WITHOUT_FORCES

#: Displacement in nm. Forces in single precision then give a stiffness of 1e6 kJ/mol/nm^2 to 0.1 %.
DISPLACEMENT = 1e-4

#: So many atoms are looked at.
MOST_ATOMS = 8


def stiffest_force(context: openmm.Context, positions: np.ndarray, atoms: Sequence[int]) -> str | None:
    """What a message says of the stiffest Force on some atoms, at positions (N, 3) in nm; None if no Force is stiff.

    A second Context is made for it, and the given one is left alone.
    """
    system = openmm.XmlSerializer.clone(context.getSystem())
    forces = [force for force in system.getForces() if not isinstance(force, WITHOUT_FORCES)][:GROUPS]
    names = [f"{force.getName()} ({type(force).__name__}) of force group {force.getForceGroup()}" for force in forces]
    for group, force in enumerate(forces):
        force.setForceGroup(group)
        if isinstance(force, openmm.NonbondedForce):
            force.setReciprocalSpaceForceGroup(group)
    other = openmm.Context(system, openmm.VerletIntegrator(0.001), context.getPlatform())
    other.setState(context.getState(parameters=True))
    masses, found = tables.masses(system), []
    for atom in [i for i in atoms if masses[i] > 0][:MOST_ATOMS]:
        for group, name in enumerate(names):
            strength = max(_pull_back(other, positions, atom, axis, group) for axis in range(3))
            if np.isfinite(strength) and strength > 0:
                found.append((strength / masses[atom], strength, atom, name))
    if not found:
        return None
    _, strength, atom, name = max(found)
    return f"the stiffest force on these atoms is {name}, with {strength:.3g} kJ/mol/nm^2 on atom {atom}"


def _pull_back(context: openmm.Context, positions: np.ndarray, atom: int, axis: int, group: int) -> float:
    """Second derivative of a group's energy by a coordinate of an atom, kJ/mol/nm^2."""
    forces = []
    for shift in (DISPLACEMENT, -DISPLACEMENT):
        moved = positions.copy()
        moved[atom, axis] += shift
        context.setPositions(moved)
        context.computeVirtualSites()
        state = context.getState(forces=True, groups={group})
        forces.append(state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)[atom, axis])
    return float(forces[1] - forces[0]) / (2 * DISPLACEMENT)
