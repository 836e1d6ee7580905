"""Systems whose NonbondedForce is inside another Force, or is replaced by one with charges."""

import copy

import openmm


def at_rest(system, *inner):
    """An ATMForce of Forces, whose two states are the same for all particles of a System."""
    force = openmm.ATMForce(0.5, 0.5, 0, 0, 0, 0, 0, 0, 1)
    for _ in range(system.getNumParticles()):
        force.addParticle(openmm.Vec3(0, 0, 0))
    for one in inner:
        force.addForce(one)
    return force


def scaled(inner, factor=1.0, energy="factor*U"):
    """A CustomCVForce of the energy U of a Force."""
    force = openmm.CustomCVForce(energy)
    force.addGlobalParameter("factor", factor)
    force.addCollectiveVariable("U", inner)
    return force


def of_charges(system, nonbonded):
    """A ConstantPotentialForce with the charges of a NonbondedForce, which is left in the System without them."""
    force = openmm.ConstantPotentialForce()
    force.setCutoffDistance(nonbonded.getCutoffDistance())
    force.setEwaldErrorTolerance(nonbonded.getEwaldErrorTolerance())
    for i in range(nonbonded.getNumParticles()):
        charge, sigma, epsilon = nonbonded.getParticleParameters(i)
        force.addParticle(charge)
        nonbonded.setParticleParameters(i, 0, sigma, epsilon)
    for i in range(nonbonded.getNumExceptions()):
        a, b, product, sigma, epsilon = nonbonded.getExceptionParameters(i)
        force.addException(a, b, product)
        nonbonded.setExceptionParameters(i, a, b, 0, sigma, epsilon)
    nonbonded.setNonbondedMethod(nonbonded.CutoffPeriodic)
    nonbonded.setUseDispersionCorrection(True)
    system.addForce(nonbonded)
    return force


#: Ways to put a NonbondedForce elsewhere, which leave the potential energy as it is.
CONTAINERS = {
    "ATMForce": at_rest,
    "CustomCVForce": lambda system, inner: scaled(inner),
    "CustomCVForce in ATMForce": lambda system, inner: at_rest(system, scaled(inner)),
    "ConstantPotentialForce": of_charges,
}


def contained(system, name):
    """A copy of a System, its NonbondedForce being where `CONTAINERS` puts it."""
    system = copy.deepcopy(system)
    number = next(i for i, force in enumerate(system.getForces()) if isinstance(force, openmm.NonbondedForce))
    inner = copy.deepcopy(system.getForce(number))
    system.removeForce(number)
    system.addForce(CONTAINERS[name](system, inner))
    return system
