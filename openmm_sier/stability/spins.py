"""Spin of rigid bodies about small moments of inertia, and the steps in which forces on it are sampled often enough.

A body that is nearly a line, such as a trimer of 178 degrees, has one moment that is smaller than the others by orders
of magnitude. At a temperature T it spins about that axis with angular velocities of sqrt(kT/I). Free spin is exact at
any step; but atoms beside the axis feel other forces in every direction, and kicks sample these once a step. Where the
body turns too far from one kick to the next, the torque about the axis is noise, and the energy walks. Exact lines have
no such spin. The frequency does not come from a stiffness, and is not among the vibrations.

For 64 trimers like CO2 of 172 to 178 degrees, at 250 K, rms(H)/rms(V) within 1.5 ps was, by the angle sqrt(kT/I) h:
    SIER2          0.3 0.0015, 0.4 0.0025, 0.7 0.007, 1.0 0.014, 1.4 0.04, 1.9 0.07    a line 0.001 to 0.008
    SIER4G, SIER4  0.4 0.00004, 0.7 0.0001, 1.0 0.0005, 1.3 0.003, 1.9 0.02            a line 0.00005
"""

import math
from collections.abc import Callable, Sequence

import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.stability import advice
from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.user_warnings import warn

#: K, where no heat bath tells the temperature.
ROOM_TEMPERATURE = 300.0

#: Angular velocities in units of sqrt(kT/I) that a step must bear: one body in twenty spins faster. A scheme bears what
#: it bears of vibrations, its `accuracy_limit`; by the table above the error is then up to 0.002.
FAST = 2.0

#: Radians. Where a body turns so far in a step at sqrt(kT/I), two kicks a turn, steps are refused.
ALIASED = math.pi


class Spins:
    """Judge steps by the fastest spin of a System's rigid bodies."""

    def __init__(self, system: openmm.System, species: Sequence[Species], describe: Callable):
        """
        Args:
            system: openmm.System.
            species: its rigid bodies.
            describe: gives a name to particle indices, for messages.
        """
        moments = [(float(each.moments[each.moments > 0].min()), each) for each in species if each.moments.any()]
        self._moment, slim = min(moments, key=lambda pair: pair[0], default=(math.inf, None))
        self._name = "" if slim is None else describe(slim.atoms[0])
        self._groups = 0 if slim is None else _field_groups(system, slim.atoms.shape[1])
        self._told = False

    def longest_step(self, scheme: Scheme, groups: int, temperature: float) -> float:
        """Return the longest step without a warning, ps, with the arguments of `check`; infinite if nothing turns."""
        if not groups & self._groups or not temperature:
            return math.inf
        return scheme.accuracy_limit / (FAST * math.sqrt(GAS_CONSTANT * temperature / self._moment))

    def check(self, scheme: Scheme, h: float, groups: int, temperature: float = ROOM_TEMPERATURE) -> None:
        """Refuse a step in which bodies turn too far between two kicks; warn, once, if it is inaccurate.

        Args:
            scheme: whose kicks act.
            h: its step, ps.
            groups: bit mask of the force groups in them.
            temperature: in K.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        accurate = self.longest_step(scheme, groups, temperature)
        if h <= accurate:
            return
        turned = h * math.sqrt(GAS_CONSTANT * temperature / self._moment)
        described = (
            f"{self._name} and similar bodies have a moment of inertia of only {self._moment:.2g} dalton nm^2 about "
            f"one axis. At {temperature:g} K they turn about it by {turned:.2g} radians from one kick to the next. "
            f"{scheme.name} is accurate up to {1000 * accurate:.2g} fs"
        )
        remedies = advice.SHORTER_STEP, advice.STRAIGHTEN
        if turned >= ALIASED:
            raise advice.StepError(advice.advised(f"A step of {1000 * h:.3g} fs is too long: {described}", *remedies))
        if not self._told:
            self._told = True
            message = advice.advised(f"A step of {1000 * h:.3g} fs is long: {described}", *remedies)
            warn(advice.StepWarning(message))


def _field_groups(system: openmm.System, atoms: int) -> int:
    """Return a bit mask of groups that may turn a body of so many atoms; if it is alone, of external Forces."""
    particles = sum(not system.isVirtualSite(i) for i in range(system.getNumParticles()))
    acting = [force for force in system.getForces() if kind_of(force).exerts_forces and not _is_empty(force)]
    if particles == atoms:
        acting = [force for force in acting if kind_of(force).acts_on == "particles"]
    groups = 0
    for force in acting:
        groups |= 1 << force.getForceGroup()
    return groups


def _is_empty(force: openmm.Force) -> bool:
    """Tell whether a Force is a NonbondedForce between particles without charges and van der Waals interactions."""
    if not isinstance(force, openmm.NonbondedForce):
        return False
    charge, _, epsilon = tables.atom_parameters(force).T
    return not (charge.any() or epsilon.any())
