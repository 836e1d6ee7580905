"""What in a System limits how well energy is conserved; figures are those of docs/accuracy.md."""

from __future__ import annotations

from collections.abc import Iterator

import openmm

from openmm_sier.prepare.pme import meshed_forces
from openmm_sier.system.notices import tell

#: Largest ewaldErrorTolerance that serves every scheme.
TOLERANCE = 1e-4


def energy_limits(system: openmm.System) -> tuple[str, ...]:
    """A sentence for each limit that another way to create the System would remove."""
    return tuple(dict.fromkeys(_limits(system)))


def _limits(system: openmm.System) -> Iterator[str]:
    for force in system.getForces():
        if _jumps(force):
            cutoff = force.getCutoffDistance()._value
            yield (
                f"{force.getName()} ends with a jump of the energy at {cutoff:.3g} nm, which in water at 0.9 nm leaves "
                f"SIER4G 0.2 to 0.3 % of rms(H)/rms(V) in place of 0.1 %: create the System with "
                f"switchDistance={5 / 6 * cutoff:.2g}*nanometer."
            )
    if any(force.getEwaldErrorTolerance() > TOLERANCE for force in meshed_forces(system)):
        yield (
            f"This ewaldErrorTolerance serves SIER4G. For SIER4P take {TOLERANCE:g}, which in water at 6 fs has "
            "0.0145 % in place of 0.056 %."
        )


def _jumps(force: openmm.Force) -> bool:
    """Whether the van der Waals energy of a Force is cut off and not switched off."""
    if not isinstance(force, openmm.NonbondedForce | openmm.CustomNonbondedForce):
        return False
    without = force.NoCutoff, *([force.LJPME] if isinstance(force, openmm.NonbondedForce) else [])
    if force.getNonbondedMethod() in without or force.getUseSwitchingFunction():
        return False
    if isinstance(force, openmm.CustomNonbondedForce):
        return True
    return any(force.getParticleParameters(i)[2]._value for i in range(force.getNumParticles()))


def tell_of_pme(system: openmm.System, scheme: str) -> None:
    """Warn of PME as OpenMM splits it, with an integrator of fourth order.

    Args:
        system: openmm.System.
        scheme: name of the integrator's scheme.
    """
    loose = [force for force in meshed_forces(system) if not force.getPMEParameters()[0]._value]
    if loose:
        tell(
            f"PME is split as OpenMM does it, and its jump at the cut-off limits {scheme}: at OpenMM's defaults "
            "rms(H)/rms(V) of water is 1.2 to 1.6 %, hardly better than with Verlet. After prepare_system(system) it "
            f"is 0.1 % at the same cost (this System has ewaldErrorTolerance={loose[0].getEwaldErrorTolerance():g})"
        )
