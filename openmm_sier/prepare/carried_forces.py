"""Forces of a System that gets particles without interactions: entries for these, and what would change otherwise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system.bonded_terms import TERMS, WITHOUT_FORCES
from openmm_sier.system.inner_forces import Part, parts

#: Name of the parameter by which custom Forces tell atoms, for which it is 1, from added particles.
IS_ATOM = "openmm_sier_is_atom"

#: Unit of the energy of a surface.
SURFACE_TENSION = unit.kilojoule_per_mole / unit.nanometer**2

#: Of the radius of a particle by which a GBSAOBCForce takes volume from others; it must be positive.
LEAST_SCALE = 1e-9

#: Forces that name their particles, and those that need none.
UNCHANGED = (
    *(*TERMS, openmm.CustomCompoundBondForce, openmm.CustomExternalForce, openmm.CustomHbondForce),
    *(openmm.AmoebaTorsionTorsionForce, openmm.CustomVolumeForce, openmm.CustomCVForce),
    *(*WITHOUT_FORCES, openmm.RPMDMonteCarloBarostat),
)


@dataclass(frozen=True)
class Added:
    """Particles at the end of a System that interact with nothing.

    Attributes:
        masses: of the particles before, as they were, (N,), dalton.
        held: those before that have no mass of their own any more, (k,).
        models: for each particle that is added one before, whose parameters are valid for it too.
    """

    masses: np.ndarray
    held: np.ndarray
    models: Sequence[int]

    @property
    def before(self) -> list[int]:
        """Return the number of particles before."""
        return list(range(len(self.masses)))


def carry_forces(system: openmm.System, added: Added) -> None:
    """Give the Forces of a System entries for added particles, also those that other Forces contain.

    Energies and forces of all other particles stay what they were, but for long-range corrections: for N particles
    these are proportional to N/(N + 1) by OpenMM's formula.

    Args:
        system: openmm.System, whose Forces are changed.
        added: the particles.

    Raises:
        ValueError: a Force cannot be carried. The message has its name.
    """
    for part in parts(system):
        force = part.force
        carry = next((each for kind, each in CARRIED.items() if isinstance(force, kind)), None)
        if carry is not None:
            carry(part, force, added)
        elif not isinstance(force, UNCHANGED):
            raise _refusal(part, "this package does not know how to exclude the particles of frames from it")


def _refusal(part: Part, why: str, remedy: str = "") -> ValueError:
    remedy = remedy or "Give the bodies to a SIER integrator, by bodies=…, which needs no frames; or remove the Force"
    return ValueError(
        f"{part.name} ({type(part.force).__name__}) cannot be copied to a System with frames: {why}. {remedy}"
    )


def _entries(*parameters: Any) -> Callable:
    """Return what adds a particle with fixed parameters for each one that is added."""

    def carry(part: Part, force: openmm.Force, added: Added) -> None:
        for _ in added.models:
            force.addParticle(*parameters)

    return carry


def _born_radii(part: Part, force: openmm.GBSAOBCForce, added: Added) -> None:
    if force.getSurfaceAreaEnergy().value_in_unit(SURFACE_TENSION) != 0:
        raise _refusal(
            part,
            "its energy of the surface area counts every particle, those of the frames too",
            "Create the System with gbsaModel=None, or call setSurfaceAreaEnergy(0)",
        )
    # Without charge it has no energy, and with a scale that rounding hides it takes no place from others.
    _entries(0.0, 0.1, LEAST_SCALE)(part, force, added)


def _drude(part: Part, force: openmm.DrudeForce, added: Added) -> None:
    held = set(added.held.tolist())
    for i in range(force.getNumParticles()):
        if touched := held & set(force.getParticleParameters(i)[:5]):
            raise _refusal(
                part, f"atom {min(touched)} of a body has a Drude particle, and the frame takes the masses of atoms"
            )


def _chosen(part: Part, force: Any, added: Added) -> None:
    """Name the particles of a Force that takes all where none is named."""
    if not list(force.getParticles()):
        force.setParticles(added.before)


def _referred(part: Part, force: Any, added: Added) -> None:
    _chosen(part, force, added)
    force.setReferencePositions(
        [*force.getReferencePositions().value_in_unit(unit.nanometer), *(openmm.Vec3(0, 0, 0) for _ in added.models)]
    )


def _centroids(part: Part, force: openmm.CustomCentroidBondForce, added: Added) -> None:
    """Give groups the weights that masses were."""
    for i in range(force.getNumGroups()):
        particles, weights = force.getGroupParameters(i)
        if not weights and np.isin(particles, added.held).any():
            force.setGroupParameters(i, particles, added.masses[list(particles)].tolist())


# --- expressions ------------------------------------------------------------------------------------------------------


def _between_atoms(expression: str, *suffixes: str) -> str:
    """Return an expression that is 0 where one of its particles was added, whatever it is there."""
    energy, separator, definitions = expression.partition(";")
    atoms = "*".join(f"{IS_ATOM}{suffix}" for suffix in suffixes)
    return f"select({atoms}, {energy}, 0){separator}{definitions}"


def _mark(force: Any, added: Added) -> None:
    """Add the parameter that tells atoms from particles that are added, which get the other ones of their models."""
    force.addPerParticleParameter(IS_ATOM)
    for i in added.before:
        force.setParticleParameters(i, [*force.getParticleParameters(i), 1.0])
    for model in added.models:
        force.addParticle([*force.getParticleParameters(model)[:-1], 0.0])


def _custom_nonbonded(part: Part, force: openmm.CustomNonbondedForce, added: Added) -> None:
    if force.getNumInteractionGroups():
        # Particles in none of them do not interact.
        for model in added.models:
            force.addParticle(force.getParticleParameters(model))
        return
    _mark(force, added)
    force.setEnergyFunction(_between_atoms(force.getEnergyFunction(), "1", "2"))


def _custom_gb(part: Part, force: openmm.CustomGBForce, added: Added) -> None:
    _mark(force, added)
    alone = force.SingleParticle
    for i in range(force.getNumComputedValues()):
        name, expression, kind = force.getComputedValueParameters(i)
        if kind != alone:
            force.setComputedValueParameters(i, name, _between_atoms(expression, "1", "2"), kind)
    for i in range(force.getNumEnergyTerms()):
        expression, kind = force.getEnergyTermParameters(i)
        suffixes = ("",) if kind == alone else ("1", "2")
        force.setEnergyTermParameters(i, _between_atoms(expression, *suffixes), kind)


def _many_particles(part: Part, force: openmm.CustomManyParticleForce, added: Added) -> None:
    force.addPerParticleParameter(IS_ATOM)
    for i in added.before:
        parameters, kind = force.getParticleParameters(i)
        force.setParticleParameters(i, [*parameters, 1.0], kind)
    for model in added.models:
        parameters, kind = force.getParticleParameters(model)
        force.addParticle([*parameters[:-1], 0.0], kind)
    suffixes = map(str, range(1, force.getNumParticlesPerSet() + 1))
    force.setEnergyFunction(_between_atoms(force.getEnergyFunction(), *suffixes))


#: What is done to Forces that want something for each particle, or that read masses.
CARRIED: dict[type, Callable[[Part, Any, Added], None]] = {
    openmm.NonbondedForce: _entries(0.0, 1.0, 0.0),
    openmm.ConstantPotentialForce: _entries(0.0),
    openmm.GayBerneForce: _entries(1.0, 0.0, -1, -1, *(1.0 for _ in range(6))),
    openmm.LCPOForce: _entries(0.0, 0.0, 0.0, 0.0, 0.0),
    openmm.ATMForce: _entries(openmm.Vec3(0, 0, 0)),
    openmm.GBSAOBCForce: _born_radii,
    openmm.CustomNonbondedForce: _custom_nonbonded,
    openmm.CustomGBForce: _custom_gb,
    openmm.CustomManyParticleForce: _many_particles,
    openmm.CustomCentroidBondForce: _centroids,
    openmm.RMSDForce: _referred,
    openmm.OrientationRestraintForce: _referred,
    openmm.RGForce: _chosen,
    openmm.PythonForce: _chosen,
    openmm.DrudeForce: _drude,
}
