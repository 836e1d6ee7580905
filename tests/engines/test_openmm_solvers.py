"""Constraints that OpenMM's own solvers cannot satisfy: this package does it, or refuses."""

import inspect

import numpy as np
import openmm
import pytest
from scipy.linalg import null_space

from openmm_sier import RigidBodies, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.observe.openmm_integrators import make_integrator
from tests.support.constrained_molecules import benzene, formate, gas, methane, triangle
from tests.support.matrices import representatives
from tests.support.waters import energies, phase_point, platform

#: The last two are points that constraints join, the others are bodies.
KINDS = {
    "methane": methane(),
    "formate": formate(),
    "benzene": benzene(),
    "HDO": triangle([16.0, 1.0, 2.0]),
    "carbon dioxide": triangle([12.0, 16.0, 16.0], np.pi, 0.116),
    "methane without a constraint": methane().without((1, 2)),
    "formate without a constraint": formate().without((2, 3)),
}
PLATFORMS = representatives(("Reference", "CPU"), "CPU")


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


def context_of(kind, integrator=None, name="Reference", edge=2):
    # Benzene is 0.5 nm wide.
    system, positions = gas(kind, edge, 0.6 if len(kind.masses) < 12 else 0.9)
    if integrator is None:
        bodies = RigidBodies.from_system(system, positions=positions)
        integrator = SIERIntegrator(0.002, engine="exact", bodies=bodies)
    context = openmm.Context(system, integrator, platform(name))
    context.setPositions(positions)
    return context, positions


def free_part(context, kind, velocities):
    """The part of velocities that the molecules can have, (N, 3), and the number of their degrees of freedom.

    That of rigid motion where all distances are constrained: to first order nothing keeps atoms in the plane of a
    molecule. Otherwise all motion that leaves constrained distances as they are.
    """
    x, roots = phase_point(context)[0].reshape(-1, *kind.places.shape), np.repeat(np.sqrt(kind.masses), 3)
    results, freedoms = [], 0
    for places, theirs in zip(x, velocities.reshape(x.shape), strict=True):
        if len(kind.pairs) == len(places) * (len(places) - 1) // 2:
            turns = [np.cross(axis, places - places[0]).ravel() for axis in np.eye(3)]
            basis = np.concatenate([np.tile(np.eye(3), len(places)), turns]) * roots
        else:
            gradients = np.zeros((len(kind.pairs), *places.shape))
            for row, (i, j) in zip(gradients, kind.pairs, strict=True):
                row[i], row[j] = places[i] - places[j], places[j] - places[i]
            basis = null_space(gradients.reshape(len(kind.pairs), -1) / roots).T
        results.append(np.linalg.pinv(basis) @ basis @ (roots * theirs.ravel()) / roots)
        freedoms += len(basis)
    return np.reshape(results, velocities.shape), freedoms


def misfit(context):
    """Largest error of a constrained distance, nm."""
    system, (x, _) = context.getSystem(), phase_point(context)
    results = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
    return max(abs(np.linalg.norm(x[i] - x[j]) - length._value) for i, j, length in results)


@pytest.mark.parametrize("name", PLATFORMS)
def test_velocities_of_a_temperature(kind, name):
    context, _ = context_of(kind, name=name, edge=3)
    context.setVelocitiesToTemperature(300, 5)
    _, v = phase_point(context)
    results, freedoms = free_part(context, kind, v)
    # Velocities of some nm/ps, with projections of points that are solved to 1e-11.
    assert np.abs(results - v).max() < 1e-9
    kinetic = 0.5 * (np.tile(kind.masses, 27)[:, None] * v**2).sum()
    # Four standard deviations of the chi-squared distribution; the seed is fixed.
    assert abs(2 * kinetic / (GAS_CONSTANT * 300 * freedoms) - 1) < 4 * np.sqrt(2 / freedoms)
    other = []
    for seed in ((5,), (6,), ()):
        context.setVelocitiesToTemperature(300 * openmm.unit.kelvin, *seed)
        other.append(phase_point(context)[1])
    assert np.array_equal(other[0], v)
    assert not np.array_equal(other[1], v)
    assert not np.array_equal(other[2], other[1])
    with pytest.raises(ValueError, match=r"temperature .*-1"):
        context.setVelocitiesToTemperature(-1)


@pytest.mark.parametrize("name", PLATFORMS)
def test_constraints_are_applied(kind, name):
    context, positions = context_of(kind, name=name)
    context.applyConstraints(1e-6)
    # A shape from lengths of double precision; that of a planar molecule is taken for planar up to 3e-7 of its size.
    assert np.abs(phase_point(context)[0] - positions).max() < 1e-12
    random = np.random.default_rng(2)
    context.setPositions(positions + 1e-4 * random.standard_normal(positions.shape))
    context.applyConstraints(1e-6)
    assert misfit(context) < 1e-12
    assert np.abs(phase_point(context)[0] - positions).max() < 1e-3
    drawn = random.standard_normal(positions.shape)
    context.setVelocities(drawn)
    context.applyVelocityConstraints(1e-6)
    expected, _ = free_part(context, kind, drawn)
    assert np.abs(phase_point(context)[1] - expected).max() < 1e-9


@pytest.mark.parametrize("name", PLATFORMS)
def test_energy_is_minimized(kind, name):
    context, positions = context_of(kind, name=name)
    before = energies(context)[0]
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 200)
    assert energies(context)[0] < before
    assert misfit(context) < 1e-12
    assert np.abs(phase_point(context)[0] - positions).max() > 1e-3
    context.setVelocitiesToTemperature(50, 1)
    start = sum(energies(context))
    context.getIntegrator().step(20)
    # Second order in steps of 2 fs: a hundredth of the kinetic energy of some 30 kJ/mol.
    assert abs(sum(energies(context)) - start) < 0.3


@pytest.mark.parametrize("make", [SIERIntegrator, SIERHMCIntegrator, SIERLangevinIntegrator])
def test_the_native_engine_refuses(kind, make):
    arguments = {SIERIntegrator: (0.002,), SIERHMCIntegrator: (300, 0.002), SIERLangevinIntegrator: (300, 1, 0.002)}
    message = r"OpenMM cannot satisfy the constraints of atoms 0, 1, 2.*engine='exact'"

    def first_step():
        context, _ = context_of(kind, make(*arguments[make], engine="native"))
        context.getIntegrator().step(1)

    with pytest.raises(openmm.OpenMMException, match=message):
        first_step()


def test_the_native_engine_refuses_before_it_changes_anything():
    """At the first call for which OpenMM would solve constraints."""
    context, positions = context_of(methane().without((1, 2)), SIERIntegrator(0.002, engine="native"))
    for call in (
        lambda: context.setVelocitiesToTemperature(300, 1),
        lambda: context.applyConstraints(1e-6),
        lambda: context.applyVelocityConstraints(1e-6),
        lambda: openmm.LocalEnergyMinimizer.minimize(context),
        lambda: context.getIntegrator().step(1),
    ):
        with pytest.raises(openmm.OpenMMException, match="atoms 0, 1, 2, 3, 4"):
            call()
        assert np.array_equal(phase_point(context)[0], positions)
        assert not phase_point(context)[1].any()


def test_constraints_of_a_bent_line_are_those_of_a_line():
    """Lengths of three digits: a body of 179 degrees would turn about its axis by several radians in a step."""
    bodies = RigidBodies.from_system(gas(triangle([12.0, 16.0, 16.0], np.radians(179.5), 0.116), 2)[0])
    assert not bodies.moments[0].any()


def test_integrators_of_openmm_are_not_given_them():
    system, positions = gas(methane())
    with pytest.raises(openmm.OpenMMException, match="constraints of atoms 0"):
        make_integrator(system, positions, "verlet", 0.002)


def test_surplus_constraints_make_nothing_hotter():
    """A bath heats benzene, whose constraints are more than its coordinates, from rest: that is no runaway."""
    context, positions = context_of(benzene(), SIERLangevinIntegrator(300, 50, 0.002), edge=3)
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 20)
    context.setVelocities(0 * positions)
    context.getIntegrator().step(20)
    assert context.getIntegrator().computeTemperatures().in_kelvin().total > 100


def test_water_is_left_to_openmm():
    """Velocities for a seed are OpenMM's, bit for bit."""
    context, _ = context_of(triangle([16.0, 1.0, 1.0]))
    results = []
    for draw in (openmm.Context.setVelocitiesToTemperature, inspect.unwrap(openmm.Context.setVelocitiesToTemperature)):
        draw(context, 300, 4)
        results.append(phase_point(context)[1])
    assert np.array_equal(*results)
