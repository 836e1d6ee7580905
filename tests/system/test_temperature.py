"""Degrees of freedom and temperatures: which motion is heat, by conservation laws."""

import itertools
import math

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    BodyState,
    RigidBodies,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    SIERThermostatIntegrator,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import Langevin, VelocityRescaling
from openmm_sier.system.temperature import degrees_of_freedom, temperatures
from tests.support.flexible_systems import started
from tests.support.molecules import GEOMETRIES, ION, ensemble, scattered
from tests.support.systems import assembled, field, with_forces
from tests.support.waters import context_at, periodic_system, phase_point

N = 59


@pytest.fixture(scope="module")
def box():
    return periodic_system(removeCMMotion=False)


def nve():
    return SIERIntegrator(0.001, "SIER2")


def langevin(friction=1.0, **options):
    return SIERLangevinIntegrator(300, friction, 0.001, scheme=SIER2, **options)


def external(group=0):
    force = field("x", [0])
    force.setForceGroup(group)
    return force


def compound(expression):
    force = openmm.CustomCompoundBondForce(2, expression)
    force.addBond([0, 3])
    return force


def of_pairs(expression):
    force = openmm.CustomManyParticleForce(2, expression)
    for _ in range(3 * N):
        force.addParticle()
    return force


def variable(force):
    collective = openmm.CustomCVForce("cv")
    collective.addCollectiveVariable("cv", force)
    return collective


#: Integrator, what is added to the System, and degrees of freedom that hold no heat.
CASES = {
    "constant energy": (nve, [], 3),
    "constant energy, motion removed": (nve, [openmm.CMMotionRemover()], 3),
    "constant energy, barostat": (nve, [openmm.MonteCarloBarostat(1, 300)], 3),
    "bath": (langevin, [], 0),
    "bath of an ensemble": (lambda: SIERThermostatIntegrator(Langevin(300, 1), 0.001, scheme=SIER2), [], 0),
    "bath of rotation alone": (lambda: langevin(0, rotationalFriction=1), [], 3),
    "momenta that are drawn": (lambda: SIERHMCIntegrator(300, 0.001, SIER2), [], 0),
    "one factor on all velocities": (
        lambda: SIERThermostatIntegrator(VelocityRescaling(300, 1), 0.001, scheme=SIER2),
        [],
        3,
    ),
    "bath without friction": (lambda: langevin(0), [], 3),
    "bath, motion removed": (langevin, [openmm.CMMotionRemover()], 3),
    "Andersen's bath": (nve, [openmm.AndersenThermostat(300, 1)], 0),
    "field": (nve, [external()], 0),
    "field that acts on nothing": (nve, [openmm.CustomExternalForce("x")], 3),
    "field as a collective variable": (nve, [variable(external())], 0),
    "bond by distance": (nve, [compound("distance(p1, p2)")], 3),
    "bond by coordinates": (nve, [compound("x1 - z2")], 0),
    "pairs by distance": (nve, [of_pairs("distance(p1, p2)")], 3),
    "pairs by coordinates": (nve, [of_pairs("x1 - z2")], 0),
}


def atomic_kinetic_energy(context):
    """From the velocities of the atoms, kJ/mol: all of it, and that of the centre of mass."""
    system = context.getSystem()
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    _, v = phase_point(context)
    return 0.5 * float(masses @ (v**2).sum(axis=1)), 0.5 * float(((masses @ v) ** 2).sum()) / masses.sum()


def moving_context(box, integrator, forces=(), drift=(0.5, -0.3, 0.2)):
    """A Context whose centre of mass moves at 0.6 nm/ps, with a fifth of the kinetic energy."""
    _, positions, system = box
    context = started(with_forces(system, *forces), integrator, positions, seed=1)
    context.setVelocities(phase_point(context)[1] + np.array(drift))
    return context


@pytest.mark.parametrize("case", CASES)
def test_degrees_of_freedom_by_what_is_conserved(box, case):
    """Without conservation all motion is heat; with it three degrees of freedom and the centre of mass are not."""
    make, forces, left_out = CASES[case]
    integrator = make()
    context = moving_context(box, integrator, forces)
    kinetic, of_centre = atomic_kinetic_energy(context)
    assert of_centre > 100
    heat = kinetic - (of_centre if left_out else 0)
    expected = 2 * heat / ((6 * N - left_out) * GAS_CONSTANT)
    assert integrator.conservesMomentum == bool(left_out)
    # Velocities as drawn by OpenMM are those of rigid bodies to 1e-5; three degrees of freedom are 1 %.
    assert integrator.computeSystemTemperature()._value == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("make", "forces", "change"),
    [
        (nve, [external(group=5)], lambda integrator: integrator.setIntegrationForceGroups({0})),
        (langevin, [], lambda integrator: integrator.setFriction(0)),
    ],
    ids=["force groups that do not move the bodies", "friction"],
)
def test_what_takes_up_momentum_counts_until_it_is_changed(box, make, forces, change):
    integrator = make()
    _context = moving_context(box, integrator, forces)
    assert not integrator.conservesMomentum
    change(integrator)
    assert integrator.conservesMomentum


@pytest.mark.parametrize("fixed", [False, True])
def test_fixed_particles_take_up_momentum_and_virtual_sites_do_not(fixed):
    system = assembled((1.0, 1.0, 0.0))
    if not fixed:
        system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    integrator = nve()
    _context = context_at(system, integrator, (np.eye(3), np.zeros((3, 3))))
    assert integrator.conservesMomentum == (not fixed)


def test_kinds_of_bodies_have_their_degrees_of_freedom():
    bodies = scattered(list(GEOMETRIES), each=10, n_free=0)
    assert degrees_of_freedom(bodies, conserved=False) == (3 * 70, 10 * (4 * 3 + 2 * 2), 0)
    assert degrees_of_freedom(bodies, conserved=True) == (3 * 70 - 3, 10 * (4 * 3 + 2 * 2), 0)


def test_nothing_that_moves_has_no_temperature():
    ions, state = ensemble(ION, 1)
    assert np.isnan(temperatures(ions, state, conserved=True)).all()
    total, translation, rotation, flexible = temperatures(ions, state, conserved=False)
    assert total == translation > 0
    assert math.isnan(rotation)
    assert math.isnan(flexible)
    none = RigidBodies([], 3)
    empty = BodyState(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros((3, 3, 0)), np.zeros((3, 0)))
    for conserved in (True, False):
        assert np.isnan(list(itertools.chain(temperatures(none, empty, conserved)))).all()


# --- domains ---

#: Three atoms each; the two of a chain are joined by a point.
TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.05, 0.12, 0.0]])


def domains(chains=4, field_of=0.0):
    """Rigid triangles in pairs that a bead joins by bonds, and as many alone: System, positions in nm and bodies.

    Args:
        chains: number of pairs.
        field_of: strength of a field, kJ/mol/nm^2, that takes up momentum; 0 for none.
    """
    bonds, system, positions, bodies = openmm.HarmonicBondForce(), openmm.System(), [], []

    def triangle(x):
        bodies.append([system.addParticle(mass) for mass in (30.0, 12.0, 16.0)])
        positions.extend(TRIANGLE + np.array([x, 0, 0]))
        return bodies[-1]

    # Molecules do not interact, and begin on one place.
    for _ in range(chains):
        first = triangle(-0.35)
        bead = system.addParticle(20.0)
        positions.append([0, 0, 0])
        second = triangle(0.2)
        bonds.addBond(first[1], bead, 0.2, 2e3)
        bonds.addBond(bead, second[0], 0.2, 2e3)
        triangle(0)
    system.addForce(bonds)
    if field_of:
        system.addForce(field(f"{field_of}*(x^2+y^2+z^2)", range(len(positions))))
    else:
        system.addForce(openmm.CMMotionRemover(1))
    return system, np.array(positions), RigidBodies.from_system(system, rigid=bodies, positions=np.array(positions))


@pytest.mark.parametrize("conserved", [True, False])
def test_canonical_temperatures_of_domains_that_linkers_join(conserved):
    """Means and fluctuations of translation, rotation and beads over a run in a bath.

    Of d degrees of freedom the temperature has the mean T and the relative variance 2/d. With a friction of 50/ps
    momenta are forgotten within 20 fs, so that samples every 60 fs are independent.
    """
    system, positions, bodies = domains(field_of=0.0 if conserved else 100.0)
    integrator = SIERLangevinIntegrator(300, 50, 0.005, scheme=SIER2, bodies=bodies)
    integrator.setRandomNumberSeed(3)
    context = context_at(system, integrator, (positions, 0 * positions), steps=400)
    results = []
    for _ in range(600):
        integrator.step(12)
        results.append(integrator.computeTemperatures().in_kelvin())
    assert integrator.conservesMomentum == conserved
    dof = degrees_of_freedom(integrator.bodies, conserved)
    if not conserved:
        assert dof == (12 * 3, 12 * 3, 4 * 3)
    assert sum(dof) == pytest.approx(12 * 6 + 4 * 3 - 3 * conserved, rel=1e-12)
    results = np.array(results)
    for temperatures_of, freedoms in zip(results.T, (sum(dof), *dof), strict=True):
        # Standard errors of the mean, and of the variance of a chi-squared variable, whose kurtosis is 12/d. Rounding
        # decides signs of the bodies' axes, and so what noise turns them. Seven of the one and eight of the other have
        # probabilities below 1e-10 also with the skewness of 12 degrees of freedom.
        error = 1 / math.sqrt(len(results))
        assert temperatures_of.mean() == pytest.approx(300, rel=7 * error * math.sqrt(2 / freedoms))
        variance = 2 * 300**2 / freedoms
        assert temperatures_of.var() == pytest.approx(variance, rel=8 * error * math.sqrt(2 + 12 / freedoms))
    assert context.getStepCount() == 400 + 12 * 600


def test_temperatures_are_quantities():
    """`computeTemperatures` and `computeSystemTemperature` agree in value and unit; numbers are had by name."""
    system, positions, bodies = domains(chains=1)
    integrator = SIERIntegrator(0.001, "SIER2", bodies=bodies)
    _context = started(system, integrator, positions)
    temperatures = integrator.computeTemperatures()
    assert temperatures.total == integrator.computeSystemTemperature()
    assert all(each.unit == unit.kelvin for each in temperatures)
    assert temperatures.in_kelvin().as_quantities() == temperatures
