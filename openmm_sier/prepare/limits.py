"""What in a System limits how well energy is conserved; figures are those of docs/accuracy.md."""

from __future__ import annotations

import openmm

from openmm_sier.prepare.pme import meshed_forces
from openmm_sier.system.notices import tell

#: Largest ewaldErrorTolerance that serves every scheme.
TOLERANCE = 1e-4


def energy_limits(system: openmm.System) -> tuple[str, ...]:
    """A sentence for each limit that another way to create the System would remove."""
    found = [
        f"{force.getName()} ends with a jump of the energy at {(cutoff := force.getCutoffDistance()._value):.3g} nm, "
        "which in water at 0.9 nm leaves SIER4G 0.2 to 0.3 % of rms(H)/rms(V) in place of 0.1 %: create the System "
        f"with switchDistance={5 / 6 * cutoff:.2g}*nanometer."
        for force in system.getForces()
        if _jumps(force)
    ]
    if any(force.getEwaldErrorTolerance() > TOLERANCE for force in meshed_forces(system)):
        found.append(
            f"This ewaldErrorTolerance serves SIER4G. For SIER4P take {TOLERANCE:g}, which in water at 6 fs has "
            "0.0145 % in place of 0.056 %."
        )
    return tuple(found)


def _jumps(force: openmm.Force) -> bool:
    """Whether the van der Waals energy of a Force is cut off and not switched off."""
    if isinstance(force, openmm.CustomNonbondedForce):
        return force.getNonbondedMethod() != force.NoCutoff and not force.getUseSwitchingFunction()
    if not isinstance(force, openmm.NonbondedForce) or force.getUseSwitchingFunction():
        return False
    epsilons = (force.getParticleParameters(i)[2]._value for i in range(force.getNumParticles()))
    return force.getNonbondedMethod() not in (force.NoCutoff, force.LJPME) and any(epsilons)


def tell_of_pme(system: openmm.System, scheme: str) -> None:
    """Warn of PME as OpenMM splits it, with an integrator of fourth order, whose scheme has this name."""
    loose = [force for force in meshed_forces(system) if not force.getPMEParameters()[0]._value]
    if loose:
        tell(
            f"PME is split as OpenMM does it, and its jump at the cut-off limits {scheme}: at OpenMM's defaults "
            "rms(H)/rms(V) of water is 1.2 to 1.6 %, hardly better than with Verlet. After prepare_system(system) it "
            f"is 0.1 % at the same cost (this System has ewaldErrorTolerance={loose[0].getEwaldErrorTolerance():g})"
        )
