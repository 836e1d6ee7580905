"""What Forces do besides giving forces: they may change positions, velocities or the box in `updateContextState`."""

from __future__ import annotations

import openmm

#: These are known to do nothing; with any other kind in the System the Context is told and read each step.
PASSIVE_FORCES = (
    openmm.NonbondedForce,
    openmm.HarmonicBondForce,
    openmm.HarmonicAngleForce,
    openmm.PeriodicTorsionForce,
    openmm.RBTorsionForce,
    openmm.CMAPTorsionForce,
    openmm.GBSAOBCForce,
    openmm.GayBerneForce,
    openmm.RMSDForce,
    openmm.CustomBondForce,
    openmm.CustomAngleForce,
    openmm.CustomTorsionForce,
    openmm.CustomExternalForce,
    openmm.CustomCompoundBondForce,
    openmm.CustomCentroidBondForce,
    openmm.CustomNonbondedForce,
    openmm.CustomGBForce,
    openmm.CustomHbondForce,
    openmm.CustomManyParticleForce,
    # It has an effect, which `Engine._without_drift` takes over: a sum over bodies is cheaper than reading atoms back.
    openmm.CMMotionRemover,
)

#: These change the box and positions together, and neither read nor change velocities.
BAROSTATS = (
    openmm.MonteCarloBarostat,
    openmm.MonteCarloAnisotropicBarostat,
    openmm.MonteCarloMembraneBarostat,
    openmm.MonteCarloFlexibleBarostat,
)


def is_passive(force) -> bool:
    """Whether a Force does nothing but give forces, whatever the time."""
    if isinstance(force, openmm.CustomCVForce):
        return all(is_passive(force.getCollectiveVariable(i)) for i in range(force.getNumCollectiveVariables()))
    return isinstance(force, PASSIVE_FORCES)
