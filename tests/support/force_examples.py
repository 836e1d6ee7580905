"""An example of each Force class of OpenMM, in which four atoms of eight have a term or all have parameters."""

import numpy as np
import openmm

from tests.support.systems import assembled, field

#: nm.
POSITIONS = np.array(
    [
        [0.10, 0.12, 0.15],
        [0.25, 0.13, 0.11],
        [0.33, 0.27, 0.16],
        [0.48, 0.22, 0.25],
        [0.57, 0.36, 0.22],
        [0.71, 0.31, 0.38],
        [0.62, 0.72, 0.55],
        [0.28, 0.81, 0.63],
    ]
)

#: dalton.
MASSES = (12.0, 14.0, 16.0, 12.0, 14.0, 16.0, 12.0, 14.0)

#: Edge of the periodic box, nm.
EDGE = 3.0

#: Charges, e.
CHARGES = 0.3 * (-1.0) ** np.arange(len(MASSES))


def of_each_particle(force, *parameters, charges=False):
    """A Force with an entry for each particle, whose charge may come first."""
    for charge in CHARGES:
        force.addParticle(*([charge] if charges else []), *parameters)
    return force


def of_term(force, method, *term):
    """A Force with a term that one of its methods adds."""
    getattr(force, method)(*term)
    return force


def correction_map():
    force = openmm.CMAPTorsionForce()
    force.addMap(4, np.random.default_rng(1).normal(size=16))
    force.addTorsion(0, 0, 1, 2, 3, 1, 2, 3, 4)
    return force


def torsions_of_amoeba():
    force = openmm.AmoebaTorsionTorsionForce()
    angles = np.linspace(-180, 180, 13)
    grid = [[[x, y, x / 90 + np.sin(y), 0.1, 0.1, 0.1] for y in angles] for x in angles]
    force.setTorsionTorsionGrid(0, grid)
    force.addTorsionTorsion(0, 1, 2, 3, 4, -1, 0)
    return force


def multipoles():
    force = openmm.AmoebaMultipoleForce()
    force.setPolarizationType(force.Direct)
    for charge in CHARGES:
        force.addMultipole(charge, [0.0] * 3, [0.0] * 9, force.NoAxisType, -1, -1, -1, 0.39, 0.1, 0.001)
    return force


def hippo():
    force = openmm.HippoNonbondedForce()
    for charge in CHARGES:
        force.addParticle(
            charge,
            [0.0] * 3,
            [0.0] * 9,
            1.0,
            30.0,
            1.0,
            30.0,
            0.01,
            1.0,
            1.0,
            30.0,
            0.001,
            force.NoAxisType,
            -1,
            -1,
            -1,
        )
    return force


def generalized_kirkwood():
    return of_each_particle(openmm.AmoebaGeneralizedKirkwoodForce(), 0.15, 0.7, charges=True)


def van_der_waals():
    force = openmm.AmoebaVdwForce()
    for number in range(len(MASSES)):
        force.addParticle(number, 0.2, 0.5, 1.0)
    return force


def generalized_born():
    force = openmm.CustomGBForce()
    force.addComputedValue("I", "1/r", force.ParticlePairNoExclusions)
    force.addEnergyTerm("I^2", force.SingleParticle)
    return of_each_particle(force, [])


def ellipsoids():
    force = openmm.GayBerneForce()
    for number in range(len(MASSES)):
        force.addParticle(0.2, 1.0, (number + 1) % 8, (number + 2) % 8, 0.1, 0.15, 0.2, 1.0, 1.5, 2.0)
    return force


def centroids(energy="50*distance(g1, g2)"):
    force = openmm.CustomCentroidBondForce(2, energy)
    force.addGroup([0, 1])
    force.addGroup([2, 3])
    force.addBond([0, 1])
    return force


def donors(energy="50*distance(d1, a1)"):
    force = openmm.CustomHbondForce(energy)
    force.addDonor(0, 1, 2)
    force.addAcceptor(3, 4, 5)
    return force


def drude():
    return of_term(openmm.DrudeForce(), "addParticle", 1, 0, -1, -1, -1, -1.0, 0.001, 1.0, 1.0)


def python():
    """A pull on two atoms that grows with the time."""
    size = np.zeros_like(POSITIONS)
    size[0, 0], size[1, 0] = 5.0, -5.0

    def pull(state):
        strength = 1 + state.getTime().value_in_unit(openmm.unit.picosecond)
        x = state.getPositions(asNumpy=True).value_in_unit(openmm.unit.nanometer)
        return strength * 5 * (x[1, 0] - x[0, 0]), strength * size

    return openmm.PythonForce(pull)


def variables():
    return of_term(openmm.CustomCVForce("50*r"), "addCollectiveVariable", "r", compound(2, "distance(p1, p2)"))


def displaced():
    force = openmm.ATMForce(0.5, 0.5, 0, 0, 0, 0, 0, 0, 1)
    for _ in MASSES:
        force.addParticle(openmm.Vec3(0, 0, 0))
    force.addForce(EXAMPLES[openmm.HarmonicBondForce]())
    return force


def compound(n=4, energy="50*(distance(p1, p2) + distance(p3, p4))"):
    return of_term(openmm.CustomCompoundBondForce(n, energy), "addBond", list(range(n)))


def of_three(energy="5*(distance(p1, p2) + distance(p2, p3))"):
    return of_each_particle(openmm.CustomManyParticleForce(3, energy))


#: Functions that make them.
EXAMPLES = {
    openmm.HarmonicBondForce: lambda: of_term(openmm.HarmonicBondForce(), "addBond", 0, 1, 0.1, 1000),
    openmm.HarmonicAngleForce: lambda: of_term(openmm.HarmonicAngleForce(), "addAngle", 0, 1, 2, 1.5, 100),
    openmm.PeriodicTorsionForce: lambda: of_term(openmm.PeriodicTorsionForce(), "addTorsion", 0, 1, 2, 3, 2, 0.3, 5),
    openmm.RBTorsionForce: lambda: of_term(openmm.RBTorsionForce(), "addTorsion", 0, 1, 2, 3, 1, 2, 3, 4, 5, 6),
    openmm.CMAPTorsionForce: correction_map,
    openmm.CustomBondForce: lambda: of_term(openmm.CustomBondForce("50*r"), "addBond", 0, 1),
    openmm.CustomAngleForce: lambda: of_term(openmm.CustomAngleForce("50*theta"), "addAngle", 0, 1, 2),
    openmm.CustomTorsionForce: lambda: of_term(openmm.CustomTorsionForce("50*cos(theta)"), "addTorsion", 0, 1, 2, 3),
    openmm.AmoebaTorsionTorsionForce: torsions_of_amoeba,
    openmm.CustomCompoundBondForce: compound,
    openmm.CustomHbondForce: donors,
    openmm.NonbondedForce: lambda: of_each_particle(openmm.NonbondedForce(), 0.2, 1.0, charges=True),
    openmm.ConstantPotentialForce: lambda: of_each_particle(openmm.ConstantPotentialForce(), charges=True),
    openmm.AmoebaMultipoleForce: multipoles,
    openmm.HippoNonbondedForce: hippo,
    openmm.AmoebaVdwForce: van_der_waals,
    openmm.AmoebaWcaDispersionForce: lambda: of_each_particle(openmm.AmoebaWcaDispersionForce(), 0.15, 0.5),
    openmm.AmoebaGeneralizedKirkwoodForce: generalized_kirkwood,
    openmm.CustomNonbondedForce: lambda: of_each_particle(openmm.CustomNonbondedForce("1/r"), []),
    openmm.CustomGBForce: generalized_born,
    openmm.GBSAOBCForce: lambda: of_each_particle(openmm.GBSAOBCForce(), 0.15, 0.8, charges=True),
    openmm.LCPOForce: lambda: of_each_particle(openmm.LCPOForce(), 0.3, 0.5, -0.1, -0.01, 0.001),
    openmm.GayBerneForce: ellipsoids,
    openmm.CustomManyParticleForce: of_three,
    openmm.CustomExternalForce: lambda: field("100*x^2", [0]),
    openmm.CustomVolumeForce: lambda: openmm.CustomVolumeForce("v"),
    openmm.CustomCentroidBondForce: centroids,
    openmm.RMSDForce: lambda: openmm.RMSDForce(POSITIONS * [1, 1.3, 0.8]),
    openmm.RGForce: lambda: openmm.RGForce(range(4)),
    openmm.OrientationRestraintForce: lambda: openmm.OrientationRestraintForce(1000, POSITIONS * [1, 1.3, -0.8]),
    openmm.DrudeForce: drude,
    openmm.PythonForce: python,
    openmm.ATMForce: displaced,
    openmm.CustomCVForce: variables,
    openmm.CMMotionRemover: lambda: openmm.CMMotionRemover(1),
    openmm.AndersenThermostat: lambda: openmm.AndersenThermostat(300, 1e6),
    openmm.MonteCarloBarostat: lambda: openmm.MonteCarloBarostat(1e5, 300, 1),
    openmm.MonteCarloAnisotropicBarostat: lambda: openmm.MonteCarloAnisotropicBarostat(
        [1e5] * 3, 300, True, True, True, 1
    ),
    openmm.MonteCarloMembraneBarostat: lambda: openmm.MonteCarloMembraneBarostat(1e5, 0, 300, 0, 0, 1),
    openmm.MonteCarloFlexibleBarostat: lambda: openmm.MonteCarloFlexibleBarostat(1e5, 300, 1),
    openmm.RPMDMonteCarloBarostat: lambda: openmm.RPMDMonteCarloBarostat(1e5, 1),
}


def system_of(kind, more_particles=0):
    """A periodic System with the example of a class, and perhaps particles for which it has no parameters."""
    system = assembled([*MASSES, *more_particles * [10.0]], EXAMPLES[kind]())
    system.setDefaultPeriodicBoxVectors(*EDGE * np.eye(3))
    # Without bonds: it makes the System periodic.
    box = openmm.CustomBondForce("0")
    box.setUsesPeriodicBoundaryConditions(True)
    system.addForce(box)
    if kind is openmm.AmoebaGeneralizedKirkwoodForce:
        # It needs the multipoles.
        system.addForce(multipoles())
    return system
