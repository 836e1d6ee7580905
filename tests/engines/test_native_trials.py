"""Hybrid Monte Carlo whose trajectories OpenMM follows by itself."""

from __future__ import annotations

import copy
import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4G, tune
from openmm_sier.engines.native.program import EXACT_ONLY
from tests.support import samplers
from tests.support.methanols import positions_of, system_of
from tests.support.restarts import assert_same
from tests.support.samplers import KT, counted, energies_computed
from tests.support.subprocesses import run_python
from tests.support.waters import cluster_system, context_at, energies, periodic_system, phase_point, platform, relaxed

PARTS_KEPT = pytest.mark.parametrize("options", [{}, {"frictionCoeff": 20.0}], ids=["drawn anew", "kept in part"])


@pytest.fixture(scope="module")
def cluster():
    topology, positions, system = cluster_system(4)
    return system, relaxed(topology, positions, system)


def sampler(h=0.008, n=4, scheme=SIER2, engine="native", substeps=2, **options):
    return samplers.sampler(h, n, scheme, engine=engine, substeps=substeps, **options)


@PARTS_KEPT
def test_samples_are_at_multiples_of_the_trial(cluster, options):
    """After a rejection the Context is where the last sample was; the conserved energy counts accepted errors alone."""
    integrator = sampler(0.008, **options)
    context = context_at(cluster[0], integrator, cluster[1])
    assert integrator.engine == "native"
    integrator.step(4)
    seen = set()
    for trial in range(2, 31):
        before, accepted = phase_point(context), integrator.accepted
        energy = sum(energies(context)) - integrator.getHeat()._value
        integrator.step(3)
        assert integrator.trials == trial - 1
        assert not np.array_equal(phase_point(context)[0], before[0])
        integrator.step(1)
        assert integrator.trials == trial
        is_accepted = integrator.accepted > accepted
        seen.add(is_accepted)
        assert np.array_equal(phase_point(context)[0], before[0]) is not is_accepted
        # Energies of the Context are rounded to some 1e-9 kJ/mol.
        change = integrator.lastEnergyError * KT if is_accepted else 0.0
        assert sum(energies(context)) - integrator.getHeat()._value - energy == pytest.approx(change, abs=1e-7)
    assert seen == {True, False}
    # SETTLE's lengths are of single precision, 5e-9 nm a step.
    assert 0 <= integrator.reversalError < 1e-7


def test_samples_wells_exactly():
    """Four particles in harmonic wells, at a step so long that half of the trials are rejected."""
    system = openmm.System()
    wells = openmm.CustomExternalForce("500*(x^2+y^2+z^2)")
    for i in range(4):
        system.addParticle(10.0)
        wells.addParticle(i)
    system.addForce(wells)
    integrator = sampler(0.13, 3, frictionCoeff=3.0)
    context = context_at(system, integrator, (np.zeros((4, 3)), np.zeros((4, 3))))
    integrator.step(60)
    integrator.resetStatistics()
    rows = []
    for _ in range(1500):
        integrator.step(3)
        x, v = phase_point(context)
        rows.append([1000 * (x**2).mean() / KT, 10 * (v**2).mean() / KT, 100 * (x * v).mean() / KT])
    assert 0.3 < integrator.acceptanceRate < 0.7
    blocks = np.array(rows).reshape(25, 60, 3).mean(axis=1)
    errors = blocks.std(axis=0, ddof=1) / 5
    assert errors == pytest.approx([0.03] * 3, abs=0.03)
    # Four standard errors. Momenta that are not reversed make the last one 0.05; without a rule the first one is 1.8.
    assert (np.abs(blocks.mean(axis=0) - [1, 1, 0]) < 4 * errors).all()


@pytest.mark.parametrize(("first", "second"), [("exact", "native"), ("native", "exact")])
def test_the_other_engine_goes_on_from_the_start_of_the_trial(cluster, first, second):
    one, other = sampler(engine=first), sampler(engine=second)
    context, later = (context_at(cluster[0], integrator, cluster[1]) for integrator in (one, other))
    one.step(4)
    sample, energy = phase_point(context)[0], sum(energies(context)) - one.getHeat()._value
    one.step(2)
    later.loadCheckpoint(context.createCheckpoint())
    # Bodies are fitted to rounding, and SETTLE leaves 5e-9 nm.
    assert phase_point(later)[0] == pytest.approx(sample, abs=1e-8)
    # The momenta of the trial were drawn, which the heat counts; forces of 1e4 kJ/mol/nm times 5e-9 nm.
    assert sum(energies(later)) - other.getHeat()._value == pytest.approx(energy, abs=1e-3)
    other.step(2)
    assert (other.trials, later.getStepCount()) == (2, 8)


@pytest.mark.parametrize("change", ["positions", "step size", "parameter", "box", "force", "groups"])
def test_changes_in_mid_trial(change):
    """Positions set from outside begin another trial there; other changes begin one from the start of the last."""
    _, positions, system = periodic_system(removeCMMotion=False)
    field = openmm.CustomExternalForce("field*x")
    field.addGlobalParameter("field", 0.0)
    field.addParticle(0)
    field.setForceGroup(1)
    system.addForce(field)
    integrator = sampler(0.0001)
    context = context_at(system, integrator, (positions, np.zeros_like(positions)))
    integrator.step(4)
    sample = phase_point(context)[0]
    integrator.step(2)
    place, box = phase_point(context)[0], context.getState().getPeriodicBoxVectors()
    if change == "positions":
        context.setPositions(place + 0.25)
    elif change == "step size":
        integrator.setStepSize(0.0002)
    elif change == "parameter":
        context.setParameter("field", 1e-6)
    elif change == "box":
        context.setPeriodicBoxVectors(*(1.000001 * vector for vector in box))
    elif change == "groups":
        integrator.setIntegrationForceGroups({0})
    else:
        field.updateParametersInContext(context)
    integrator.step(1)
    start = np.array(integrator.getPerDofVariableByName("sier_start0"))
    # Positions that were set satisfy the constraints to the digits of a force field's lengths.
    assert start == pytest.approx(place + 0.25 if change == "positions" else sample, abs=1e-6)
    assert (integrator.trials, context.getStepCount()) == (1, 7)
    # The trial ends at the next multiple.
    integrator.step(1)
    assert integrator.trials == 2


def test_velocities_that_are_the_same_change_nothing(cluster):
    runs = [sampler(), sampler()]
    contexts = [context_at(cluster[0], integrator, cluster[1]) for integrator in runs]
    for integrator, context in zip(runs, contexts, strict=True):
        integrator.step(6)
        if integrator is runs[0]:
            context.setVelocities(phase_point(context)[1])
        integrator.step(6)
    assert_same(*map(counted, contexts))


def test_forces_that_are_not_finite_reject_a_trial():
    """A particle in a well that ends at x = 0.3 nm: what leaves it is rejected, and the run goes on."""
    system = openmm.System()
    system.addParticle(1.0)
    well = openmm.CustomExternalForce("sqrt(0.09-x^2)-0.3")
    well.addParticle(0)
    system.addForce(well)
    integrator = sampler(0.02, 3, seed=6)
    context = context_at(system, integrator, (np.zeros((1, 3)), np.zeros((1, 3))))
    places, failed = [], 0
    for _ in range(80):
        for steps in (2, 1):
            integrator.step(steps)
            assert np.isfinite(phase_point(context)[0]).all()
        places.append(phase_point(context)[0][0, 0])
        failed += math.isinf(integrator.lastEnergyError)
    assert failed > 3
    assert integrator.accepted > 3
    assert (context.getStepCount(), integrator.trials) == (240, 80)
    assert np.abs(places).max() < 0.3
    # Where there is no energy to begin with, nothing goes on.
    context.setPositions([[0.5, 0.0, 0.0]])
    with pytest.raises(openmm.OpenMMException, match=r"In step 241 .* energy is nan"):
        integrator.step(1)


@pytest.mark.parametrize("at", range(5))
def test_interrupts_leave_a_completed_step(cluster, monkeypatch, at):
    undisturbed = context_at(cluster[0], sampler(), cluster[1])
    undisturbed.getIntegrator().step(12)
    integrator = sampler()
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(4)
    native, calls = openmm.CustomIntegrator.step, []

    def interrupted(self, steps):
        native(self, steps)
        calls.append(steps)
        if len(calls) == 1 + at:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(openmm.CustomIntegrator, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            integrator.step(8)
    assert context.getStepCount() == 5 + at
    integrator.step(7 - at)
    assert_same(counted(context), counted(undisturbed))


def test_is_tuned(cluster):
    integrator = sampler(0.002, 3)
    context = context_at(cluster[0], integrator, cluster[1])
    found = tune(context, acceptance=0.8, trials=10, samples=10, lengths=[2, 3])
    assert (integrator.getStepSize()._value, integrator.getStepsPerTrial()) == (found.stepSize, found.stepsPerTrial)
    assert found.stepSize > 0.002
    assert integrator.trials == 0


def test_energies_are_computed_twice(cluster, monkeypatch):
    """At the start of a trial after a rejection, and at its end: at most two for each."""
    integrator = sampler(0.011)
    _context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(4)
    computed = energies_computed(monkeypatch)
    integrator.step(40)
    assert 0 < integrator.accepted < 11
    assert 10 <= sum(computed) <= 20


def test_a_trajectory_that_does_not_come_back_is_refused(cluster, monkeypatch):
    integrator = sampler()
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(4)
    before = phase_point(context)
    integrator.setStepSize(0.009)
    monkeypatch.setattr("openmm_sier.integrators.hmc.REVERSIBLE", -1.0)
    with pytest.raises(openmm.OpenMMException, match=r"4 steps .* missed its start"):
        integrator.step(1)
    assert_same(phase_point(context), before)
    assert (context.getStepCount(), context.getTime()._value) == (4, pytest.approx(0.032, abs=1e-15))


def test_constrained_molecules():
    integrator = sampler(0.004, 3, SIER4G)
    positions = positions_of(2)
    _context = context_at(system_of(2), integrator, (positions, np.zeros_like(positions)))
    integrator.step(9)
    assert integrator.trials == 3
    # Constraints are solved to 1e-9.
    assert integrator.reversalError < 1e-7
    assert abs(integrator.lastEnergyError) < 100


def test_what_it_cannot_do_is_refused_or_left_to_the_exact_engine():
    system = periodic_system()[2]
    for options, remedy in (({}, "removeCMMotion=False"), ({"pressure": 1}, "leave it out")):
        with pytest.raises(openmm.OpenMMException, match=remedy + ".*engine='exact'"):
            openmm.Context(system, sampler(**options), platform())
        integrator = sampler(engine="auto", **options)
        openmm.Context(system, integrator, platform())
        assert integrator._prefers_exact("CUDA")
    still = copy.deepcopy(system)
    for i in reversed(range(still.getNumForces())):
        if isinstance(still.getForce(i), openmm.CMMotionRemover):
            still.removeForce(i)
    integrator = sampler(engine="auto")
    openmm.Context(still, integrator, platform())
    assert not integrator._prefers_exact("CUDA")


STRANGER = """
import sys, openmm
system = openmm.System()
system.addParticle(1.0)
integrator = openmm.XmlSerializer.deserialize(open(sys.argv[1]).read())
context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
context.setPositions([[0, 0, 0]])
try:
    integrator.step(1)
except openmm.OpenMMException as error:
    print(error)
"""


def test_fails_without_this_package(cluster, tmp_path):
    """OpenMM alone would accept every trial."""
    integrator = sampler()
    _context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(6)
    assert integrator.getGlobalVariableByName(EXACT_ONLY) == 1
    plain = tmp_path / "integrator.xml"
    plain.write_text(openmm.XmlSerializer.serialize(integrator))
    assert "import_openmm_sier" in run_python(STRANGER, plain)
