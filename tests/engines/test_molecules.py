"""Molecules that are not rigid, in the exact engine: conservation, temperatures and refusals."""

import gc
import math
import warnings
import weakref

import numpy as np
import openmm
import pytest

from openmm_sier import (
    RigidBodies,
    RigidityError,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.exact import motion
from openmm_sier.engines.exact.fast_force_context import FastForceError
from tests.support.flexible import chains, residual, rotor
from tests.support.flexible_systems import FAST, started, system_of, total_energy
from tests.support.methanols import GEOMETRY, positions_of
from tests.support.methanols import system_of as methanols_of
from tests.support.peptides import capped_alanine
from tests.support.restarts import assert_restart_is_the_same, assert_same, everything
from tests.support.seeded import seeded
from tests.support.waters import context_at, judged, phase_point, platform

X_H = ((0, 1), (0, 2), (0, 3), (4, 5))


@pytest.mark.parametrize(("nested", "constrained"), [(False, True), (True, True), (False, False), (True, False)])
def test_an_isolated_cluster_keeps_momentum_and_angular_momentum(nested, constrained):
    """Two chains and three waters, without a field; an ion would be a point without a group to turn."""
    system, positions = system_of(chains(constrained, field=False), waters=3)
    integrator = SIERIntegrator(0.003, fastForceGroups={FAST} if nested else None)
    context = started(system, integrator, positions)
    context.setVelocities(phase_point(context)[1] + [1.0, 2.0, -0.5])
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])

    def totals():
        """Of the atoms: points have no angular momentum of their own, whatever their states carry."""
        x, v = phase_point(context)
        p = masses[:, None] * v
        return np.concatenate([p.sum(axis=0), np.cross(x, p).sum(axis=0)])

    integrator.step(0)
    before = totals()
    integrator.step(40)
    # 40 steps with some twenty roundings of all momenta, of 30 dalton nm/ps, each.
    assert np.abs(totals() - before).max() < 1e-10
    assert np.abs(before).max() > 10


# --- temperatures and degrees of freedom ---


def test_temperatures_of_what_is_rigid_and_what_is_not():
    system, positions = system_of(chains(), waters=4, ions=2)
    integrator = SIERIntegrator(0.0005, "SIER2")
    context = started(system, integrator, positions)
    bodies = integrator.bodies
    assert bodies.dof == (18 * 3 - 12) + 4 * 6 + 2 * 3
    kinetic = context.getState(energy=True).getKineticEnergy()._value
    # The field acts on absolute positions, so that the centre of mass has its heat.
    total = 2 * kinetic / (bodies.dof * GAS_CONSTANT)
    kelvins = integrator.computeTemperatures().in_kelvin()
    # Velocities drawn by OpenMM satisfy the constraints to 1e-5.
    assert kelvins.total == pytest.approx(total, rel=1e-4)
    weights = 6 * 3, 4 * 3, 18 * 3 - 12
    assert np.dot(weights, kelvins[1:]) / sum(weights) == pytest.approx(kelvins.total, rel=1e-12)
    v = phase_point(context)[1][:18]
    masses = np.array([system.getParticleMass(i)._value for i in range(18)])
    chain = (masses * (v**2).sum(axis=1)).sum() / ((18 * 3 - 12) * GAS_CONSTANT)
    assert kelvins.flexible == pytest.approx(chain, rel=1e-4)


# --- fast forces ---


@pytest.mark.parametrize("early", [False, True])
def test_parameters_of_fast_forces_that_are_changed_take_effect(early):
    """By `updateParametersInContext` and by a parameter of the Context, as in a new Context."""
    system, positions = system_of(chains())
    custom = openmm.CustomBondForce("stiffness*(r-0.5)^2")
    custom.addGlobalParameter("stiffness", 100.0)
    custom.addBond(0, 9)
    custom.setForceGroup(FAST)
    custom = system.getForce(system.addForce(custom))
    springs = system.getForce(0)
    integrator = SIERIntegrator(0.002, fastForceGroups={FAST})
    context = started(system, integrator, positions, steps=2)
    if early:
        context.setParameter("stiffness", 300.0)
    i, j, length, constant = springs.getBondParameters(0)
    springs.setBondParameters(0, i, j, 1.1 * length, constant)
    springs.updateParametersInContext(context)
    if not early:
        context.setParameter("stiffness", 300.0)
    middle = phase_point(context)
    integrator.step(2)
    custom.setGlobalParameterDefaultValue(0, 300.0)
    other = context_at(system, SIERIntegrator(0.002, fastForceGroups={FAST}), middle, steps=2)
    # The new Context takes positions over from atoms, to rounding.
    assert np.abs(phase_point(context)[0] - phase_point(other)[0]).max() < 1e-12


def test_forces_that_cannot_be_fast_are_refused():
    system, _ = system_of(chains(), waters=1)
    system.getForce(2).setForceGroup(FAST)
    with pytest.raises(FastForceError, match=r"CustomNonbondedForce .*setForceGroup"):
        openmm.Context(system, SIERIntegrator(0.002, fastForceGroups={FAST}), platform())


# --- steps ---


def test_steps_that_are_too_long_for_fast_bonds():
    """Unconstrained C-H, of 11.4 fs: refused, warned of and taken."""
    system, _ = system_of(chains(constrained=False))
    period = 2000 * math.pi * math.sqrt(12 / 13 / 2.8e5)

    def context(h, **options):
        return judged(system, SIERIntegrator(h / 1000, fastForceGroups={FAST}, **options))

    with pytest.raises(openmm.OpenMMException, match=f"{period:.3g} fs.*more substeps"):
        context(2.1 * 3.46 / (2 * math.pi) * period, substeps=1)
    with pytest.warns(UserWarning, match=f"{period:.3g} fs"):
        context(0.47 * period)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        context(0.4 * period)


# --- faults and refusals ---


def test_a_drift_that_cannot_be_made_leaves_the_last_completed_step(monkeypatch):
    """A step in which hydrogens would go round the carbon."""
    system, positions = system_of(rotor(3))
    integrator = SIERIntegrator(0.002)
    context = started(system, integrator, positions, steps=3)
    good = everything(context)
    monkeypatch.setattr("openmm_sier.stability.step_check.StepCheck.__call__", lambda *_: None)
    integrator.setStepSize(2.0)
    with pytest.raises(openmm.OpenMMException, match="Step 4 failed"):
        integrator.step(1)
    assert_same(everything(context), good)
    integrator.setStepSize(0.002)
    integrator.step(1)
    assert context.getStepCount() == 4


def test_positions_far_off_the_constraints_are_refused():
    system, positions = system_of(rotor(3))
    integrator = SIERIntegrator(0.002)
    context = started(system, integrator, positions)
    cut = positions.copy()
    cut[2] += [0, 0, 0.4]
    context.setPositions(cut)
    with pytest.raises(RigidityError, match=r"atom|constraints"):
        integrator.step(1)
    off = positions.copy()
    off[2] += [0.002, 0, 0]
    context.setPositions(off)
    with pytest.warns(UserWarning, match="shape of their constraints"):
        mended = integrator.getBodyState().q
    assert residual(integrator.bodies.constraints, mended) < 1e-13
    integrator.step(1)


# --- minimization and pressure ---


@pytest.mark.parametrize("named", [False, True], ids=["OpenMM", "FIRE"])
def test_minimization_keeps_constraints(named):
    """With a named body, which OpenMM's minimizer would tear, ours keeps the constraints of the others too."""
    system, positions = methanols_of(3, X_H, positions_of(3, GEOMETRY, digit=0)), positions_of(3, GEOMETRY, digit=0)
    if named:
        for number in reversed(range(system.getNumConstraints())):
            if system.getConstraintParameters(number)[0] < 6:
                system.removeConstraint(number)
    bodies = RigidBodies.from_system(system, rigid=[range(6)], positions=positions) if named else None
    integrator = SIERIntegrator(0.002, bodies=bodies)
    context = context_at(system, integrator, (positions, 0 * positions))
    before = total_energy(context)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    assert total_energy(context) < before - 1
    x, _ = phase_point(context)
    for i, j, length in (system.getConstraintParameters(c) for c in range(system.getNumConstraints())):
        # OpenMM's minimizer keeps them to 1e-5.
        assert np.linalg.norm(x[i] - x[j]) == pytest.approx(length._value, rel=1e-10 if named else 1e-4)
    integrator.step(1)
    assert context.getStepCount() == 1


@pytest.mark.usefixtures("coin")
@pytest.mark.parametrize("own", [True, False], ids=["pressure", "MonteCarloBarostat"])
def test_constant_pressure(own):
    """Molecules keep their constraints to rounding while the box changes; our own moves restart to the bit.

    Of six molecules at 50 bar OpenMM's moves, of 1 %, are nearly all accepted, ours by a coin.
    """
    system, positions = system_of(chains(field=False), waters=3, ions=1, box=2.2)
    if not own:
        system.addForce(openmm.MonteCarloBarostat(50, 300, 2))
    pressure = {"pressure": 50.0, "barostatInterval": 2} if own else {}

    def integrator():
        return seeded(SIERLangevinIntegrator(300, 5, 0.002, fastForceGroups={FAST}, **pressure))

    one = integrator()
    context = started(system, one, positions + 1.0, steps=30)
    box = context.getState().getPeriodicBoxVolume()._value
    assert box != pytest.approx(2.2**3, rel=1e-6)
    assert residual(one.bodies.constraints, one.getBodyState().q) < 1e-13
    if own:
        assert_restart_is_the_same(system, context, integrator(), 9)


# --- a peptide ---


@pytest.mark.parametrize("threads", ["1", "2"])
@pytest.mark.parametrize("small", [0, 1000])
def test_fast_forces_are_those_of_the_context_wherever_they_are_computed(monkeypatch, threads, small):
    """Of a peptide, on the CPU platform or on Reference, by the number of threads and of atoms."""
    monkeypatch.setattr(motion, "FEW_ATOMS", small)
    system, positions = capped_alanine(waters=4)
    prepare_system(system)
    integrator = SIERIntegrator(0.002)
    context = openmm.Context(system, integrator, platform("CPU"), {"Threads": threads})
    context.setPositions(positions)
    integrator.step(0)
    q = integrator.getBodyState().q
    members = np.flatnonzero(integrator.bodies.flexible)
    atoms = [int(integrator.bodies.atoms_of(body)[0]) for body in members]
    expected = context.getState(forces=True, groups={FAST}).getForces(asNumpy=True)._value[atoms].T
    A = np.repeat(np.eye(3)[:, :, None], len(members), axis=2)
    results, _ = integrator.impl.engine.motion.fast_context(q[:, members].copy(), A)
    # Forces of the CPU platform pass through single precision where they are summed.
    assert np.abs(results - expected).max() < 1e-5 * np.abs(expected).max()


def test_an_engine_with_fast_forces_needs_no_garbage_collector():
    """Its second Context goes with the integrator; a collector might delete the System of that one first."""
    system, positions = system_of(chains())
    integrator = SIERIntegrator(0.002, fastForceGroups={FAST})
    context = started(system, integrator, positions, steps=1)
    motion = weakref.ref(integrator.impl.engine.motion)
    gc.disable()
    try:
        del context, integrator
        assert motion() is None
    finally:
        gc.enable()
