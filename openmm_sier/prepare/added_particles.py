"""Add entries for non-interacting particles to every Force of a System."""

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: Name of the parameter of custom Forces that is 1 for atoms and 0 for added particles.
IS_ATOM = "openmm_sier_is_atom"


@dataclass(frozen=True)
class AddedParticles:
    """Non-interacting particles at the end of a System.

    Attributes:
        masses: original masses of the other particles, (N,), dalton.
        held: particles that have become massless, (k,).
        number: number of added particles.
    """

    masses: np.ndarray
    held: np.ndarray
    number: int


#: Forces that get entries for added particles, or need none though they act on all particles.
EXTENDED = (
    openmm.NonbondedForce,
    openmm.CustomNonbondedForce,
    openmm.CustomCentroidBondForce,
    openmm.CustomCVForce,
)


def refuse_other_forces(system: openmm.System) -> None:
    """Refuse Forces that would act on added particles too.

    Raises:
        ValueError: a Force has an unsupported class. The message names the Force.
    """
    for entry in all_forces(system):
        force = entry.force
        if kind_of(force).acts_on in ("pairs", "whole") and not isinstance(force, EXTENDED):
            raise ValueError(
                f"{entry.name} ({type(force).__name__}) cannot be copied to a System with frames. Give the bodies to a "
                "SIER integrator, by bodies=…, which needs no frames; or remove the Force"
            )


def add_to_forces(system: openmm.System, added: AddedParticles) -> None:
    """Add entries for added particles to the Forces of a System that `refuse_other_forces` accepts.

    Forces inside other Forces get them too.

    Energies and forces of all other particles do not change, except for long-range corrections, which are proportional
    to N/(N + 1) for N particles by OpenMM's formula.

    Args:
        system: openmm.System, whose Forces are changed.
        added: the particles.
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


def _add_to_expression(force: openmm.CustomNonbondedForce, added: AddedParticles) -> None:
    """Add particles with the parameters of the first one, and zero energy for any expression."""
    model = list(force.getParticleParameters(0))
    if force.getNumInteractionGroups():
        # Particles outside all groups do not interact.
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
    """Set the original masses as explicit weights of groups with massless particles."""
    for i in range(force.getNumGroups()):
        particles, weights = force.getGroupParameters(i)
        if not weights and np.isin(particles, added.held).any():
            force.setGroupParameters(i, particles, added.masses[list(particles)].tolist())
