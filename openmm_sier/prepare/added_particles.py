"""Forces of a System that gets particles without interactions: entries for these, and what would change otherwise."""

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: Name of the parameter by which custom Forces tell atoms, for which it is 1, from added particles.
IS_ATOM = "openmm_sier_is_atom"


@dataclass(frozen=True)
class AddedParticles:
    """Particles at the end of a System that interact with nothing.

    Attributes:
        masses: of the particles before, as they were, (N,), dalton.
        held: those before that have no mass of their own any more, (k,).
        number: how many are added.
    """

    masses: np.ndarray
    held: np.ndarray
    number: int


def add_to_forces(system: openmm.System, added: AddedParticles) -> None:
    """Give the Forces of a System entries for added particles, also those that other Forces contain.

    Energies and forces of all other particles stay what they were, but for long-range corrections: for N particles
    these are proportional to N/(N + 1) by OpenMM's formula.

    Args:
        system: openmm.System, whose Forces are changed.
        added: the particles.

    Raises:
        ValueError: a Force is of another class than those of common models. The message has its name.
    """
    for entry in all_forces(system):
        force = entry.force
        if isinstance(force, openmm.NonbondedForce):
            for _ in range(added.number):
                force.addParticle(0.0, 1.0, 0.0)
        elif isinstance(force, openmm.CustomNonbondedForce):
            _add_to_expression(force, added)
        elif isinstance(force, openmm.CustomCentroidBondForce):
            _keep_weights(force, added)
        elif kind_of(force).acts_on in ("pairs", "whole") and not isinstance(force, openmm.CustomCVForce):
            raise ValueError(
                f"{entry.name} ({type(force).__name__}) cannot be copied to a System with frames. Give the bodies to a "
                "SIER integrator, by bodies=…, which needs no frames; or remove the Force"
            )


def _add_to_expression(force: openmm.CustomNonbondedForce, added: AddedParticles) -> None:
    """Add particles, with the parameters of the first one, whose energy is 0 whatever its expression is there."""
    model = list(force.getParticleParameters(0))
    if force.getNumInteractionGroups():
        # Particles in none of them do not interact.
        for _ in range(added.number):
            force.addParticle(model)
        return
    force.addPerParticleParameter(IS_ATOM)
    for i in range(len(added.masses)):
        force.setParticleParameters(i, [*force.getParticleParameters(i), 1.0])
    for _ in range(added.number):
        force.addParticle([*model, 0.0])
    energy, separator, definitions = force.getEnergyFunction().partition(";")
    force.setEnergyFunction(f"select({IS_ATOM}1*{IS_ATOM}2, {energy}, 0){separator}{definitions}")


def _keep_weights(force: openmm.CustomCentroidBondForce, added: AddedParticles) -> None:
    """Give groups the weights that masses were."""
    for i in range(force.getNumGroups()):
        particles, weights = force.getGroupParameters(i)
        if not weights and np.isin(particles, added.held).any():
            force.setGroupParameters(i, particles, added.masses[list(particles)].tolist())
