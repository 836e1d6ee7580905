"""What must hold with compiled kernels, on OpenCL. `test_kernels_engine` runs this module where they are installed.

Few Contexts are made here: OpenMM compiles some hundred kernels for each.
"""

import math

import numpy as np
import openmm
import openmm_sier_kernels
import pytest

from openmm_sier import SIER2, SIER2V2, SIER4G, RigidBodies, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines import trials
from openmm_sier.engines.compiled import trial_engine
from openmm_sier.ensembles import metropolis
from tests.support import anharmonic, kernels
from tests.support.ethane import ethane
from tests.support.restarts import full_state
from tests.support.seeded import seeded
from tests.support.systems import assembled
from tests.support.waters import cluster_system, energies, periodic_system, phase_point, platform, settled


def context_on(system, integrator, point, precision="mixed", name="OpenCL"):
    properties = {"Precision": precision} if name == "OpenCL" else {}
    context = openmm.Context(system, integrator, platform(name), properties)
    context.setPositions(point[0])
    context.setVelocities(point[1])
    return context


# --- steps ---


@pytest.fixture(scope="module")
def all_kinds():
    """Bodies of all kinds at 300 K, on their shapes, and the exact engine's Context."""
    system, positions, bodies = kernels.all_kinds()
    integrator = SIERIntegrator(0.004, SIER2, bodies=bodies, engine="exact")
    context = context_on(system, integrator, (positions, 0 * positions), name="Reference")
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(1)
    return system, bodies, phase_point(context)


@pytest.mark.parametrize("scheme", [SIER2, SIER4G], ids=lambda scheme: scheme.name)
def test_bodies_of_all_kinds_move_as_with_the_exact_engine(all_kinds, scheme):
    """Rings, lines, mirror images, bodies of 150 atoms, a water with a virtual site, points, and a frozen atom."""
    system, bodies, point = all_kinds
    compiled = SIERIntegrator(0.004, scheme, bodies=bodies, engine="kernels")
    exact = SIERIntegrator(0.004, scheme, bodies=bodies, engine="exact")
    contexts = context_on(system, compiled, point, "double"), context_on(system, exact, point, name="Reference")
    assert compiled.engine == "kernels"
    for integrator in (compiled, exact):
        integrator.step(10)
    (x, v), (expected_x, expected_v) = map(phase_point, contexts)
    # OpenMM adds forces in units of 2^-32 kJ/mol/nm. In 0.04 ps an error of one unit moves 3 Da by 6e-14 nm, and atoms
    # of the large bodies have 10^2 pairs each.
    assert np.abs(x - expected_x).max() < 1e-11
    massive = [system.getParticleMass(i)._value > 0 for i in range(system.getNumParticles())]
    assert np.abs(v - expected_v)[massive].max() < 1e-10
    assert contexts[0].getStepCount() == 10
    assert contexts[0].getTime()._value == pytest.approx(0.04, abs=1e-15)
    assert compiled.computeSystemTemperature()._value == pytest.approx(exact.computeSystemTemperature()._value)


def test_fast_forces_and_constraints_of_one_atom():
    """Ethane, whose C-H bonds are constrained, as on Reference by the native engine."""
    system, positions = ethane()
    for force in system.getForces():
        force.setForceGroup(isinstance(force, openmm.HarmonicBondForce))
    start = openmm.Context(system, openmm.VerletIntegrator(0.001), platform())
    start.setPositions(positions)
    start.applyConstraints(1e-12)
    start.setVelocitiesToTemperature(300, 1)
    start.applyVelocityConstraints(1e-12)
    point = phase_point(start)
    results = []
    for engine, name in (("kernels", "OpenCL"), ("native", "Reference")):
        integrator = SIERIntegrator(0.002, SIER4G, engine=engine, fastForceGroups={1})
        context = context_on(system, integrator, point, "double", name)
        integrator.step(20)
        results.append(phase_point(context))
        assert integrator.engine == engine
    # The native engine leaves relative errors of 1e-9 of the constraints in each of some hundred drifts.
    assert np.abs(results[0][0] - results[1][0]).max() < 1e-8
    x, v = results[0]
    for i in range(system.getNumConstraints()):
        first, second, length = system.getConstraintParameters(i)
        bond, speed = x[first] - x[second], v[first] - v[second]
        assert np.linalg.norm(bond) == pytest.approx(length._value, abs=1e-12)
        assert abs(bond @ speed) < 1e-12


def test_velocities_along_constraints_are_taken_away_beside_named_bodies():
    """OpenMM's own method would take away what belongs to the body too."""
    system = assembled([16.0, 1.0, 1.0, 14.0, 16.0])
    for hydrogen in (1, 2):
        system.addConstraint(0, hydrogen, 0.1)
    positions = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [1, 0, 0], [1.1, 0, 0]])
    bodies = RigidBodies.from_system(system, None, [[3, 4]], positions)
    integrator = SIERIntegrator(0.001, SIER2, bodies=bodies, engine="kernels")
    context = context_on(system, integrator, (positions, np.random.default_rng(1).normal(size=(5, 3))), "double")
    context.applyVelocityConstraints(1e-9)
    velocities = phase_point(context)[1]
    assert abs(velocities[1, 0] - velocities[0, 0]) < 1e-12
    assert abs(velocities[2, 1] - velocities[0, 1]) < 1e-12
    assert abs(velocities[4, 0] - velocities[3, 0]) < 1e-12
    assert np.abs(velocities).max() > 0.1


def test_a_context_that_is_made_again_follows_its_system_as_it_is_then():
    """A barostat that was added; at 10^5 bar every move to a smaller box is accepted.

    Before, nothing acts between steps, so that the step of the first Context lets nothing act.
    """
    _, system, point = settled("box-59", *periodic_system())
    kinds = [type(force) for force in system.getForces()]
    if openmm.CMMotionRemover in kinds:
        system.removeForce(kinds.index(openmm.CMMotionRemover))
    integrator = seeded(SIERLangevinIntegrator(300, 1, 0.002, engine="kernels"), 3)
    context = context_on(system, integrator, point)
    integrator.step(2)
    volume = context.getState().getPeriodicBoxVolume()._value
    system.addForce(openmm.MonteCarloBarostat(1e5, 300, 1))
    context.reinitialize(preserveState=True)
    assert integrator.engine == "kernels"
    integrator.step(10)
    assert context.getState().getPeriodicBoxVolume()._value < volume
    x = phase_point(context)[0].reshape(-1, 3, 3)
    assert np.ptp(np.linalg.norm(x[:, 1] - x[:, 0], axis=1)) < 1e-6


def test_energy_is_conserved_where_atoms_are_reordered():
    """A box of water over 300 steps; OpenMM orders molecules anew after 250."""
    _, system, point = settled("box-59", *periodic_system())
    integrator = SIERIntegrator(0.002, SIER4G, engine="kernels")
    context = context_on(system, integrator, point)
    integrator.step(10)
    start = sum(energies(context))
    integrator.step(290)
    # Errors of SIER4G at 2 fs are 0.01 kJ/mol; PME in single precision adds 0.1. Molecules that are torn, or have the
    # axes of others, change it by hundreds.
    assert sum(energies(context)) == pytest.approx(start, abs=1.0)
    x = phase_point(context)[0].reshape(-1, 3, 3)
    assert np.ptp(np.linalg.norm(x[:, 1] - x[:, 0], axis=1)) < 1e-12


def test_named_bodies_stay_whole_where_atoms_are_reordered():
    """Pairs that nothing but their names joins, which cross a box in 300 steps; OpenMM orders molecules after 250."""
    edge, length, pairs = 2.0, 0.15, 20
    force = openmm.CustomNonbondedForce("0")
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.5)
    for _ in range(2 * pairs):
        force.addParticle()
    system = assembled((12.0,) * (2 * pairs), force)
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    first = edge * np.random.default_rng(1).random((pairs, 1, 3))
    positions = (first + np.array([[0, 0, 0], [length, 0, 0]])).reshape(-1, 3)
    named = np.arange(2 * pairs).reshape(-1, 2).tolist()
    bodies = RigidBodies.from_system(system, None, named, positions)
    integrator = SIERIntegrator(0.01, SIER2, bodies=bodies, engine="kernels")
    context = context_on(system, integrator, (positions, 0 * positions))
    context.setVelocitiesToTemperature(1000, 1)
    integrator.step(300)
    x = phase_point(context)[0].reshape(-1, 2, 3)
    assert np.linalg.norm(x[:, 1] - x[:, 0], axis=1) == pytest.approx(length, abs=1e-12)


# --- baths ---

#: Number of molecules in a field, and the field times their dipole over kT.
MOLECULES, STRENGTH = 400, 2.0

#: K, and kJ/mol.
TEMPERATURE = 300.0
THERMAL = GAS_CONSTANT * TEMPERATURE

#: Half-length of a molecule, nm, and force constant of its well, kJ/mol/nm^2.
HALF, SPRING = 0.1, 500.0


@pytest.fixture(scope="module")
def in_field():
    """Independent linear molecules, rigid by name, in a uniform field and in wells."""
    field = openmm.CustomExternalForce("-q*x + k*(x*x + y*y + z*z)")
    field.addPerParticleParameter("q")
    field.addGlobalParameter("k", SPRING / 4)
    # The wells of two atoms are one of their centre, and a constant.
    push = STRENGTH * THERMAL / (2 * HALF)
    for _ in range(MOLECULES):
        for sign in (1, -1):
            field.addParticle(field.getNumParticles(), [sign * push])
    system = assembled((8.0,) * (2 * MOLECULES), field)
    positions = np.tile([[HALF, 0.0, 0.0], [-HALF, 0.0, 0.0]], (MOLECULES, 1))
    pairs = np.arange(2 * MOLECULES).reshape(-1, 2).tolist()
    bodies = RigidBodies.from_system(system, None, pairs, positions)
    integrator = seeded(SIERLangevinIntegrator(TEMPERATURE, 10.0, 0.01, bodies=bodies, countsHeat=True), 1)
    context = context_on(system, integrator, (positions, 0 * positions))
    integrator.step(200)
    return context, integrator


def test_averages_in_a_field(in_field):
    """The Langevin function, equipartition in wells, and the temperatures of both motions."""
    context, integrator = in_field
    assert integrator.engine == "kernels"
    samples = []
    for _ in range(150):
        integrator.step(20)
        x = phase_point(context)[0].reshape(-1, 2, 3)
        cosines = (x[:, 0] - x[:, 1])[:, 0] / (2 * HALF)
        centre = (x.mean(axis=1) ** 2).mean()
        samples.append([cosines.mean(), centre])
        temperatures = integrator.computeTemperatures().in_kelvin()
        samples[-1] += [temperatures.translation, temperatures.rotation]
    means, errors = np.mean(samples, axis=0), np.std(samples, axis=0, ddof=1) / math.sqrt(len(samples))
    expected = 1 / math.tanh(STRENGTH) - 1 / STRENGTH, THERMAL / SPRING
    # 0.2 ps at 10/ps leave a correlation of e^-2, by which errors of means are up to 1.3 times as large; 6.5 estimated
    # ones. The bath's angular noise about a wrong axis changes the first by 10 %.
    assert np.abs(means[:2] - expected)[0] < 1.3 * 6.5 * errors[0]
    assert np.abs(means[:2] - expected)[1] < 1.3 * 6.5 * errors[1]
    # Momenta at the end of a step lag half a kick behind; the share of a kick is below 1 % here.
    assert means[2:] == pytest.approx([TEMPERATURE] * 2, rel=0.02)


def test_heat_balances_the_energy(in_field):
    context, integrator = in_field
    before, heat = sum(energies(context)), integrator.getHeat()._value
    integrator.step(50)
    change, gained = sum(energies(context)) - before, integrator.getHeat()._value - heat
    # The bath exchanges some 10^4 kJ/mol in this time; errors of the step are 1 % of kT for each degree of freedom.
    assert change == pytest.approx(gained, abs=0.02 * 5 * MOLECULES * THERMAL)
    assert abs(gained) > 0


def test_a_checkpoint_continues_bit_for_bit(in_field):
    context, integrator = in_field
    integrator.step(3)
    checkpoint = context.createCheckpoint()
    ends = []
    for _ in range(2):
        integrator.step(5)
        ends.append((*phase_point(context), integrator.getHeat()._value))
        context.loadCheckpoint(checkpoint)
    assert (ends[0][0] == ends[1][0]).all()
    assert (ends[0][1] == ends[1][1]).all()
    assert ends[0][2] == ends[1][2]
    state = full_state(context)
    context.setState(state)
    assert np.abs(phase_point(context)[0] - state.getPositions(asNumpy=True)._value).max() < 1e-12


def test_changes_by_users(in_field):
    context, integrator = in_field
    context.setVelocitiesToTemperature(600, 1)
    integrator.setFriction(0.001)
    integrator.setStepSize(0.002)
    integrator.step(1)
    # 2000 degrees of freedom: 6.1 standard deviations.
    assert integrator.computeSystemTemperature()._value == pytest.approx(600, rel=6.1 * math.sqrt(2 / 2000))
    x = phase_point(context)[0].reshape(-1, 2, 3)
    assert np.linalg.norm(x[:, 0] - x[:, 1], axis=1) == pytest.approx(2 * HALF, abs=1e-12)
    time = context.getTime()._value
    integrator.step(1)
    assert context.getTime()._value == pytest.approx(time + 0.002)


# --- trials ---


def test_trials_sample_exactly():
    """Half of the first ends are rejected; see `anharmonic`."""
    x = anharmonic.positions()
    scheme = SIERHMCIntegrator(anharmonic.TEMPERATURE, 0.022, SIER2V2, 2, 2.0, extraChances=0, engine="kernels")
    integrator = seeded(scheme, 5)
    context = context_on(anharmonic.system(), integrator, (x, 0 * x))
    integrator.step(20)
    assert (integrator.engine, integrator.impl.engine.makes_trials) == ("kernels", True)
    integrator.resetStatistics()
    rows = []
    for _ in range(2000):
        integrator.step(1)
        rows.append(anharmonic.observed(*phase_point(context)))
    assert 0.4 < integrator.acceptanceRate < 0.6
    # Standard errors of 25 blocks, as in `test_whole_trials.py`.
    assert (np.abs(anharmonic.distances(rows)) < 4.5).all()


def test_a_trial_that_goes_on_comes_back(monkeypatch):
    """The second end is taken; from there, with reversed momenta, the second end is the start."""
    x = anharmonic.positions()
    integrator = seeded(SIERHMCIntegrator(300, 0.02, SIER2V2, 2, 2.0, extraChances=1, engine="kernels"), 5)
    context = context_on(anharmonic.system(), integrator, (x, 0 * x), "double")
    integrator.step(10)
    errors = []

    def take_second(trajectory, operation):
        trajectory._is_accepted = len(trajectory._errors) == 2
        trajectory._goes_on = not trajectory._is_accepted
        errors.append(trajectory._errors[-1])

    monkeypatch.setitem(trial_engine.BY_BLOCKS, trials.Decide, take_second)
    engine, start = integrator.impl.engine, phase_point(context)
    trial = trials.Trial(2, 1, 1.0, anharmonic.KT, 0.0, 0.0, np.zeros(3))
    engine._make(trial, False)
    end = phase_point(context)
    openmm.Context.setVelocities(context, -end[1])
    engine._make(trial, False)
    back = phase_point(context)
    assert np.abs(end[0] - start[0]).max() > 1e-3
    # Rounding, which a step of a well multiplies by less than three.
    assert np.abs(back[0] - start[0]).max() < 1e-12
    assert np.abs(back[1] + start[1]).max() < 1e-11
    assert errors[3] == pytest.approx(-errors[1], abs=1e-8)
    assert errors[2] == pytest.approx(errors[0] - errors[1], abs=1e-8)


def test_energies_of_trials_and_virtual_sites(monkeypatch):
    """Energies of the Context, whose sites are placed, change by the errors of the ends that are accepted."""
    system, point = settled("cluster-3-tip4pew", *cluster_system(3, "tip4pew"))[1:]
    system.addForce(openmm.CMMotionRemover())
    integrator = seeded(SIERHMCIntegrator(300, 0.009, stepsPerTrial=4, extraChances=0, engine="kernels"), 5)
    context = context_on(system, integrator, point)
    integrator.step(2)
    for is_accepted in (True, False, True):
        monkeypatch.setattr(metropolis, "largest_error", lambda *_, yes=is_accepted: 1e300 if yes else -1e300)
        start, accepted = phase_point(context)[0], integrator.accepted
        before = sum(energies(context)) - integrator.getHeat()._value
        integrator.step(1)
        assert integrator.accepted - accepted == is_accepted
        change = integrator.lastEnergyError * GAS_CONSTANT * 300 if is_accepted else 0.0
        # Forces and energies of mixed precision are good to 1e-6 of some 100 kJ/mol. Sites that stay behind change the
        # energy by several kJ/mol.
        assert sum(energies(context)) - integrator.getHeat()._value - before == pytest.approx(change, abs=1e-3)
        assert np.abs(integrator.impl.engine.centre_velocity()).max() < 1e-6
        assert np.abs(phase_point(context)[0] - start).max() > 1e-4 if is_accepted else True


# --- what is refused ---


def test_a_ring_of_constraints_is_left_to_the_native_engine():
    """Cyclopropane without hydrogens and a fourth atom that is joined to one of them."""
    system = assembled((12.0,) * 4)
    for i, j in ((0, 1), (1, 2), (0, 2), (2, 3)):
        system.addConstraint(i, j, 0.15)
    positions = np.array([[0, 0, 0], [0.15, 0, 0], [0.075, 0.13, 0], [0.075, 0.28, 0]])
    point = positions, 0 * positions
    with pytest.raises(openmm.OpenMMException, match="engine='native'"):
        context_on(system, SIERIntegrator(0.002, engine="kernels"), point)
    usual = SIERIntegrator(0.002)
    context_on(system, usual, point)
    assert usual.engine == "native"


def test_another_version_of_openmm_is_refused(monkeypatch):
    monkeypatch.setattr(openmm_sier_kernels, "VERSION", "7.0")
    with pytest.raises(openmm.OpenMMException, match=r"OpenMM 7\.0.*build it again"):
        openmm_sier_kernels.library.__wrapped__("OpenCL")


def test_a_platform_without_a_library_is_refused():
    with pytest.raises(openmm.OpenMMException, match="CPU platform"):
        openmm_sier_kernels.library("CPU")


def test_other_integrators_are_those_of_openmm():
    """One that has the variables of programs, and one of the native engine."""
    cluster, point = settled("cluster-3-tip4pew", *cluster_system(3, "tip4pew"))[1:]
    integrator = SIERIntegrator(0.002, SIER2, engine="native")
    reference = SIERIntegrator(0.002, SIER2, engine="native")
    results = []
    for each, name in ((integrator, "OpenCL"), (reference, "Reference")):
        context = context_on(cluster, each, point, "double", name)
        each.step(5)
        results.append(phase_point(context)[0])
    assert integrator.engine == "native"
    assert np.abs(results[0] - results[1]).max() < 1e-7
