"""Find bodies that a minimizer cannot part, since they overlap at a minimum of the energy."""

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.engines import interrupts
from openmm_sier.system.user_warnings import warn

#: nm, by which bodies are moved to find how stiffly others hold them. Forces in single precision, rounded to 1e-6 of
#: 1e5 kJ/mol/nm, give the stiffness to 1e3 kJ/mol/nm^2 then.
DISPLACEMENT = 1e-4

#: kJ/mol/nm^2, above which a body is held by overlaps. All bonds of an atom of a protein together have up to 1e6. Two
#: atoms with a Lennard-Jones well of 1 kJ/mol and a diameter of 0.3 nm reach it at 0.62 of that, at 1200 kJ/mol.
STIFFEST = 5e6

_FORCE = unit.kilojoule_per_mole / unit.nanometer


def warn_about_overlaps(context: openmm.Context, bodies: BodySet) -> None:
    """Warn of bodies that still overlap with others after a minimization.

    Forces do not tell, since they cancel at a minimum, and those within a rigid body may be of any size. So all bodies
    are moved by random displacements, as wholes, and the change of the forces on each is looked at. The positions are
    then those of before.

    Args:
        context: openmm.Context, after a minimization.
        bodies: that move in it.
    """
    stiffness = _stiffness(context, bodies)
    overlapping = np.flatnonzero(stiffness > STIFFEST)
    if not overlapping.size:
        return
    # Of two that hold each other the lighter is the one to move.
    worst = int(overlapping[np.argmax(stiffness[overlapping] / bodies.masses[overlapping])])
    energy = openmm.Context.getState(context, energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    warn(
        f"After the minimization, at {energy:.5g} kJ/mol, {overlapping.size} bodies or atoms still overlap with "
        f"others, most of all {bodies.describe(worst)}: the stiffness of its contacts is {stiffness[worst]:.2g} "
        "kJ/mol/nm2, and that of all bonds of an atom is up to 1e6. Minimize for longer if the iterations were "
        "limited. Otherwise it is trapped, as an atom inside a rigid body is: give other positions"
    )


def _stiffness(context: openmm.Context, bodies: BodySet) -> np.ndarray:
    """Return the change of the force on each body over its displacement, (n,), kJ/mol/nm^2; 0 if it is not finite."""
    positions = openmm.Context.getState(context, positions=True).getPositions(asNumpy=True)
    moved = bodies.owners >= 0
    owners = bodies.owners[moved]
    directions = np.random.default_rng(0).normal(size=(bodies.n, 3))
    shifts = DISPLACEMENT * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    displaced = np.array(positions.value_in_unit(unit.nanometer))
    displaced[moved] += shifts[owners]

    def forces() -> np.ndarray:
        forces = openmm.Context.getState(context, forces=True).getForces(asNumpy=True).value_in_unit(_FORCE)[moved]
        return np.stack([np.bincount(owners, column, bodies.n) for column in forces.T], axis=1)

    with interrupts.deferred():
        before = forces()
        openmm.Context.setPositions(context, displaced)
        try:
            context.computeVirtualSites()
            after = forces()
        finally:
            openmm.Context.setPositions(context, positions)
    return np.nan_to_num(np.linalg.norm(after - before, axis=1), nan=0.0, posinf=0.0) / DISPLACEMENT
