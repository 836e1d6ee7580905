"""Degrees of freedom and temperatures of rigid bodies: one rule for everything that states a temperature.

Where the total momentum is conserved, the motion of the centre of mass is no heat: three degrees of freedom are left
out, and so is the kinetic energy of that motion, whatever velocities the user has set. Where it is not conserved, a
heat bath, a field or fixed particles make it fluctuate like any other momentum, and nothing is left out.

OpenMM's StateDataReporter differs for integrators that do not compute their own temperature: it leaves out three
degrees of freedom with a CMMotionRemover alone, and never the kinetic energy of the centre of mass. A drifting box is
hotter by its account, and a deterministic run without a CMMotionRemover colder by 1/N. With a SIER integrator it asks
`computeSystemTemperature`, which follows the rule here.

Total angular momentum is not treated so. An isolated cluster conserves it too, but its rotation as a whole is part of
the thermal motion that `setVelocitiesToTemperature` draws, and no convention leaves it out.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT

#: A coordinate of a particle or group in the expression of a custom force, as x1 or z2.
COORDINATE = re.compile(r"\b[xyz][1-9]\d*\b")

ALL_GROUPS = 2**32 - 1


class DegreesOfFreedom(NamedTuple):
    """Numbers of degrees of freedom that share the heat."""

    translation: int
    rotation: int


class Temperatures(NamedTuple):
    """Temperatures in K of all motion, of translation and of rotation; NaN where there are no degrees of freedom."""

    total: float
    translation: float
    rotation: float


@dataclass(frozen=True)
class MomentumConservation:
    """Whether the total momentum of a System stays what it is.

    It is kept at zero by a CMMotionRemover, also beside a Langevin bath, whose kicks of one interval are left out with
    the motion of the centre of mass. Otherwise it is conserved unless one of these changes it: a heat bath of
    independent kicks (an integrator with a friction above zero, an AndersenThermostat), a CustomExternalForce, an
    expression of absolute coordinates in a custom force, or particles that stay where they are and act on others.
    Monte Carlo barostats leave momenta alone. Forces that cannot be looked into (PythonForce, plugins) count as
    interactions: the temperature about the centre of mass has the right mean in either case.

    Attributes:
        removed: there is a CMMotionRemover.
        fixed: particles are fixed, or an AndersenThermostat acts.
        external_groups: bit mask of the force groups in which a Force depends on absolute positions.
    """

    removed: bool
    fixed: bool
    external_groups: int

    @classmethod
    def of_system(cls, system: openmm.System, bodies: RigidBodies) -> MomentumConservation:
        """What the System and the choice of bodies say; a particle that belongs to no body stays where it is."""
        forces = system.getForces()
        fixed = any(not system.isVirtualSite(i) for i in _outside(bodies))
        return cls(
            removed=any(isinstance(force, openmm.CMMotionRemover) for force in forces),
            fixed=fixed or any(isinstance(force, openmm.AndersenThermostat) for force in forces),
            external_groups=sum({1 << force.getForceGroup() for force in forces if _is_external(force)}),
        )

    def holds(self, integrator: openmm.Integrator) -> bool:
        """Whether an integrator, with its force groups and its present friction, conserves the total momentum."""
        if self.removed:
            return True
        groups = integrator.getIntegrationForceGroups() & ALL_GROUPS
        return not (self.fixed or self.external_groups & groups or _has_friction(integrator))


def _outside(bodies: RigidBodies) -> list[int]:
    alone = np.ones(bodies.n_particles, dtype=bool)
    for species in bodies.species:
        alone[species.atoms] = False
    return np.flatnonzero(alone).tolist()


def _has_friction(integrator: openmm.Integrator) -> bool:
    if not hasattr(integrator, "getFriction"):
        return False
    friction = integrator.getFriction()
    return (friction.value_in_unit(unit.picosecond**-1) if unit.is_quantity(friction) else friction) > 0


def _is_external(force: openmm.Force) -> bool:
    """Whether the energy of a Force changes when all particles are shifted together."""
    if isinstance(force, openmm.CustomExternalForce):
        return force.getNumParticles() > 0
    if isinstance(force, openmm.CustomCVForce):
        return any(_is_external(force.getCollectiveVariable(i)) for i in range(force.getNumCollectiveVariables()))
    if isinstance(force, openmm.CustomCompoundBondForce | openmm.CustomCentroidBondForce):
        return COORDINATE.search(force.getEnergyFunction()) is not None
    return False


def degrees_of_freedom(bodies: RigidBodies, conserved: bool) -> DegreesOfFreedom:
    """Degrees of freedom that share the heat.

    Args:
        bodies: the rigid bodies.
        conserved: whether the total momentum is conserved, see `MomentumConservation`.
    """
    translation = 3 * bodies.n - (3 if conserved else 0)
    return DegreesOfFreedom(max(0, translation), bodies.dof - 3 * bodies.n)


def thermal_energies(bodies: RigidBodies, state: BodyState, conserved: bool) -> tuple[float, float]:
    """Kinetic energies of translation and rotation in kJ/mol that count as heat.

    Args:
        bodies: the rigid bodies.
        state: their phase point.
        conserved: whether the total momentum is conserved; the kinetic energy of the centre of mass is left out then.
    """
    translation, rotation = bodies.kinetic_energies(state)
    if conserved and bodies.n:
        momentum = state.p.sum(axis=1)
        translation -= 0.5 * float(momentum @ momentum) / float(bodies.masses.sum())
    return translation, rotation


def temperatures(bodies: RigidBodies, state: BodyState, conserved: bool) -> Temperatures:
    """Temperatures of a phase point.

    Args:
        bodies: the rigid bodies.
        state: their phase point.
        conserved: whether the total momentum is conserved, see `MomentumConservation`.
    """
    energies = thermal_energies(bodies, state, conserved)
    dof = degrees_of_freedom(bodies, conserved)
    return Temperatures(
        _temperature(sum(energies), sum(dof)),
        _temperature(energies[0], dof.translation),
        _temperature(energies[1], dof.rotation),
    )


def _temperature(energy: float, dof: int) -> float:
    return 2 * energy / (dof * GAS_CONSTANT) if dof > 0 else math.nan
