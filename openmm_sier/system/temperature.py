"""Degrees of freedom and temperatures of bodies.

If the total momentum is conserved, the motion of the centre of mass is not heat: its three degrees of freedom and its
kinetic energy are left out, whatever velocities the user has set. Otherwise a heat bath, a field or fixed particles
make the total momentum fluctuate like any other momentum, and nothing is left out. Each independent constraint between
bodies removes one degree of freedom, and so does each axis along or about which a body does not move.

OpenMM's StateDataReporter uses another rule for integrators that do not compute their temperature: it leaves out three
degrees of freedom only with a CMMotionRemover, and never the kinetic energy of the centre of mass. So it reports a
drifting box as hotter, and a deterministic run without a CMMotionRemover as colder by 1/N. With a SIER integrator it
calls `computeSystemTemperature`, which follows the rule above.

Total angular momentum is not treated in this way. An isolated cluster conserves it too, but the rotation of the cluster
is part of the thermal motion drawn by `setVelocitiesToTemperature`, and no convention leaves it out.
"""

import math
import re
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.vectors import body_frame
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: A coordinate of a particle or group in the expression of a custom force, such as x1 or z2.
COORDINATE = re.compile(r"\b[xyz][1-9]\d*\b")

ALL_GROUPS = 2**32 - 1


class DegreesOfFreedom(NamedTuple):
    """Numbers of degrees of freedom that share the heat.

    Attributes:
        translation: of molecules that are one body, and of rigid bodies joined to others by linkers. If the centre of
            mass holds no heat, its degrees of freedom are left out in proportion to the mass fraction of these bodies,
            so that the number need not be whole.
        rotation: of the same bodies.
        flexible: of the points of other molecules.
    """

    translation: float
    rotation: float
    flexible: float = 0.0


class Temperatures(NamedTuple):
    """Temperatures: quantities for users, numbers in K internally. NaN means no degrees of freedom.

    Attributes:
        total: of all motion.
        translation: of molecules that are one body, rigid or a point, and of rigid bodies joined to others by linkers.
        rotation: of the same bodies.
        flexible: of the points of other molecules.
    """

    total: Any
    translation: Any
    rotation: Any
    flexible: Any = math.nan

    def in_kelvin(self) -> "Temperatures":
        """Convert quantities to numbers in K."""
        return Temperatures(*(quantity.value_in_unit(unit.kelvin) for quantity in self))

    def as_quantities(self) -> "Temperatures":
        """Convert numbers in K to quantities."""
        return Temperatures(*(kelvins * unit.kelvin for kelvins in self))


class MomentumConservation:
    """Conservation of the total momentum of a System.

    A CMMotionRemover keeps the total momentum at zero, even with a Langevin bath: the heat of the centre of mass
    between two removals is left out too. Otherwise the total momentum is conserved unless one of these changes it: a
    heat bath of independent kicks (an integrator with nonzero friction, an AndersenThermostat), a CustomExternalForce,
    an expression of absolute coordinates in a custom force, or fixed particles that act on others. Bodies that do not
    move along an axis along which others do are fixed in this sense. Monte Carlo barostats do not change momenta.
    Forces that cannot be inspected (PythonForce, plugins) count as interactions: the temperature relative to the centre
    of mass has the right mean in either case.

    Attributes:
        removed: whether there is a CMMotionRemover.
    """

    def __init__(self, system: openmm.System, bodies: BodySet):
        """Inspect a System and its bodies; particles without a body are fixed."""
        forces = system.getForces()
        fixed = any(not system.isVirtualSite(i) for i in np.flatnonzero(bodies.owners < 0).tolist())
        fixed |= bool((bodies.translates.any(axis=1) & ~bodies.translates.all(axis=1)).any())
        self.removed = any(isinstance(force, openmm.CMMotionRemover) for force in forces)
        self._changes = fixed or any(isinstance(force, openmm.AndersenThermostat) for force in forces)
        self._external_groups = sum({1 << entry.group for entry in all_forces(system) if _is_external(entry.force)})

    def holds(self, groups: int, has_friction: bool) -> bool:
        """Return whether the total momentum is conserved.

        Args:
            groups: force groups that move the bodies, a bit mask.
            has_friction: whether the heat bath of the integrator kicks momenta independently, with nonzero friction.
        """
        if self.removed:
            return True
        return not (self._changes or self._external_groups & groups & ALL_GROUPS or has_friction)


def _is_external(force: openmm.Force) -> bool:
    """Return whether the energy of a Force changes when all particles are shifted together."""
    kind = kind_of(force)
    if kind.acts_on == "particles":
        return force.getNumParticles() > 0
    return kind.has_coordinates and COORDINATE.search(force.getEnergyFunction()) is not None


def number_of_freedoms(bodies: BodySet, conserved: bool) -> int:
    """Return the number of degrees of freedom that share the heat.

    Args:
        bodies: all bodies.
        conserved: the result of `MomentumConservation.holds`.
    """
    # A single particle has no heat where momentum is conserved.
    return max(0, bodies.dof - int(_left_out(bodies, conserved).sum()))


def _left_out(bodies: BodySet, conserved: bool) -> np.ndarray:
    """Return whether the motion of the centre of mass along x, y and z is left out, (3,)."""
    return np.logical_and(bodies.translates.any(axis=1), conserved)


def degrees_of_freedom(bodies: BodySet, conserved: bool) -> DegreesOfFreedom:
    """Return degrees of freedom that share the heat by kinds; `conserved` as in `number_of_freedoms`."""
    apart = _counted_apart(bodies)
    left_out = _left_out(bodies, conserved)
    share = np.ones(3)
    if not apart.all():
        np.divide(bodies.moving_masses[:, apart].sum(axis=1), bodies.moving_mass, out=share, where=left_out)
    counts = np.count_nonzero(bodies.translates[:, apart], axis=1)
    translation = max(0.0, float((counts - share * left_out).sum()))
    rotation = int(np.count_nonzero(bodies.turns[:, apart]))
    flexible = number_of_freedoms(bodies, conserved) - translation - rotation
    return DegreesOfFreedom(translation, rotation, max(0.0, flexible))


def _counted_apart(bodies: BodySet) -> np.ndarray:
    """Return which bodies have independent momenta, and so temperatures of translation and rotation, (n,).

    Constraints never join a rigid body to other bodies, so that domains of flexible molecules are among these.
    """
    return ~bodies.flexible | bodies.moments.any(axis=0)


def thermal_energies(bodies: BodySet, state: BodyState, conserved: bool) -> tuple[float, float, float]:
    """Return kinetic energies in kJ/mol that count as heat, in the order of `DegreesOfFreedom`.

    If the total momentum is `conserved`, the motion of the centre of mass is left out.
    """
    p = state.p
    if conserved and bodies.n:
        p = p - bodies.moving_masses * bodies.centre_velocity(p)[:, None]
    translation = 0.5 * (p * p).sum(axis=0) * bodies.inverse_masses
    rotation = 0.5 * (body_frame(state.A, state.L) ** 2 * bodies.inverse_moments).sum(axis=0)
    apart = _counted_apart(bodies)
    return float(translation[apart].sum()), float(rotation[apart].sum()), float(translation[~apart].sum())


def temperatures(bodies: BodySet, state: BodyState, conserved: bool) -> Temperatures:
    """Return temperatures of a phase point, K; `conserved` is the result of `MomentumConservation.holds`."""
    energies = thermal_energies(bodies, state, conserved)
    dof = degrees_of_freedom(bodies, conserved)
    return Temperatures(temperature(sum(energies), sum(dof)), *map(temperature, energies, dof))


def temperature(energy: float, dof: float) -> float:
    """Return the temperature in K of a kinetic energy in kJ/mol; NaN without degrees of freedom."""
    return 2 * energy / (dof * GAS_CONSTANT) if dof > 0 else math.nan
