"""Restarts: a run that was stopped and continued is, to the bit, the run that was not.

On the Reference platform, and on the CPU platform without a cut-off, forces are a function of positions alone. With a
cut-off the CPU platform adds up a neighbour list that depends on the atoms' past; a checkpoint ends that past. With
more than one thread its forces are left to chance, and no two runs are the same.
"""

from functools import partial
from itertools import combinations

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    SIER4,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from tests.support.commands import SYSTEMS
from tests.support.containers import contained
from tests.support.integrators import constrained_velocity_verlet
from tests.support.matrices import representatives, thorough
from tests.support.restarts import (
    after_ten_steps,
    assert_restart_is_the_same,
    assert_same,
    clock_and_box,
    everything,
    full_state,
    simulation_of,
)
from tests.support.seeded import seeded
from tests.support.systems import with_forces
from tests.support.waters import cluster_system, context_at, periodic_system, phase_point, platform, settled


def langevin(scheme, **options):
    return seeded(SIERLangevinIntegrator(297.0, 2.0, 0.001, scheme=scheme, **options))


def trials(engine="exact", **options):
    return seeded(SIERHMCIntegrator(297.0, 0.006, SIER2, stepsPerTrial=2, engine=engine, **options), 4)


MAKERS = {
    "SIER2": lambda: SIERIntegrator(0.001, "SIER2"),
    "SIER4": lambda: SIERIntegrator(0.002, "SIER4"),
    "SIER2 NVT": lambda: langevin(SIER2),
    "SIER4 NVT": lambda: langevin(SIER4),
}
every_integrator = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())

TRIALS = {
    f"HMC {engine} {name}": partial(trials, engine, **options)
    for engine in ("exact", "native")
    for name, options in (("drawn anew", {"extraChances": 0}), ("kept in part", {"frictionCoeff": 20.0}))
}

#: In a box, where restarts are also between two moves of the volume, which OpenMM's barostats do not allow.
AT_CONSTANT_PRESSURE = {
    "SIER4 NPT": lambda: langevin(SIER4, pressure=1e3, barostatInterval=4),
    "HMC exact NPT": lambda: trials("exact", pressure=1e3, barostatInterval=4),
    "HMC native NPT": lambda: trials("native", pressure=1e3, barostatInterval=4),
}

#: Kind of restart and integrator in a box on the CPU platform, where neighbour lists have a past, which is ended for
#: each kind of move and each engine. A reporter writes what `saveCheckpoint` and `saveState` write, in the middle of a
#: call of `step`. Other boxes and platforms are in `tests/laws/test_future.py`.
MATRIX = [
    ("CheckpointReporter", "SIER2"),
    ("StateReporter", "SIER2 NVT"),
    *map(
        thorough,
        (
            ("State", "SIER4"),
            ("Checkpoint", "SIER4 NVT"),
            ("Checkpoint", "HMC exact kept in part"),
            ("State", "HMC exact drawn anew"),
            ("Checkpoint", "HMC native drawn anew"),
            ("Checkpoint", "HMC native kept in part"),
            ("State", "SIER4 NPT"),
            ("Checkpoint", "HMC exact NPT"),
            ("Checkpoint", "HMC native NPT"),
        ),
    ),
]


@pytest.fixture(scope="module")
def cluster():
    return settled("cluster-6-tip4pew", *cluster_system(6, "tip4pew"))


@pytest.mark.usefixtures("coin")
@pytest.mark.parametrize(("way", "label"), MATRIX)
def test_restart_is_exact(tmp_path, box, way, label):
    """A Context continues like a restarted one, also when it loads a checkpoint.

    Positions would be 1e-8 to 1e-6 nm apart if neighbour lists had a past, and energies at the start of a trial 1e-5 to
    4e-4 kT.
    """
    topology, system, point = box
    make = (MAKERS | TRIALS | AT_CONSTANT_PRESSURE)[label]
    path = tmp_path / "saved"
    whole = simulation_of(topology, system, make(), "CPU", point)
    volume = whole.context.getState().getPeriodicBoxVolume()
    load = after_ten_steps(whole, way, path)
    ends = []
    # On the CPU platform all Contexts share OpenMM's random numbers, which native trials use.
    for steps in (1, 14):
        whole.step(steps)
        ends.append(everything(whole.context))
    continued = simulation_of(topology, system, make(), "CPU", point)
    # A past that the restart must not remember.
    continued.step(2)
    getattr(continued, load)(str(path))
    assert continued.currentStep == 10
    # Not the energy, for which OpenMM draws random numbers on the CPU platform.
    continued.context.getState(forces=True)
    for steps, end in zip((1, 14), ends, strict=True):
        continued.step(steps)
        assert_same(everything(continued.context), end)
    if load == "loadCheckpoint":
        # With a State a Context goes on with noise that it has not used yet.
        whole.loadCheckpoint(str(path))
        whole.step(15)
        assert_same(everything(whole.context), ends[-1])
    assert (whole.context.getState().getPeriodicBoxVolume() != volume) is (label in AT_CONSTANT_PRESSURE)
    if isinstance(whole.integrator, SIERHMCIntegrator):
        assert 0 < whole.integrator.accepted < whole.integrator.trials


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_a_minimization_after_a_checkpoint_is_that_of_the_restart(engine):
    """OpenMM's minimizer begins with a new list too: with one that has a past it ends 4e-10 nm away."""
    water = forcefields.read_box(SYSTEMS / "tip3p-512.pdb", interactions=Interactions(0.9, 0.75, 5e-4))
    point = water.positions, np.zeros_like(water.positions)
    integrators = [SIERIntegrator(0.002, SIER2, engine=engine) for _ in range(2)]
    whole, continued = (context_at(water.system, integrator, point, "CPU") for integrator in integrators)
    whole.setVelocitiesToTemperature(300, 1)
    # Atoms have moved since OpenMM made its list.
    whole.getIntegrator().step(10)
    continued.loadCheckpoint(whole.createCheckpoint())
    for context in (whole, continued):
        openmm.LocalEnergyMinimizer.minimize(context, 10.0, 5)
        context.getIntegrator().step(2)
    assert_same(phase_point(whole), phase_point(continued))


def test_a_checkpoint_ends_the_past(box):
    """What follows depends on nothing but what was loaded."""
    _, system, point = box
    checkpoint = context_at(system, MAKERS["SIER4"](), point, "CPU").createCheckpoint()
    ends = []
    for past in (0, 0.03):
        integrator = MAKERS["SIER4"]()
        # Nearer than the distance that makes OpenMM build another list.
        context = context_at(system, integrator, (point[0] + past, point[1]), "CPU")
        context.getState(energy=True)
        context.loadCheckpoint(checkpoint)
        integrator.step(20)
        ends.append(phase_point(context))
    assert_same(*ends)


# --- constant pressure ------------------------------------------------------------------------------------------


def with_barostat(system, frequency):
    """A System that is pressed so hard, 10^5 bar, that each move to a smaller box is accepted."""
    return with_forces(system, seeded(openmm.MonteCarloBarostat(1e5, 297.0, frequency), 5))


@pytest.mark.parametrize("label", representatives(["SIER4", "SIER2 NVT"], "SIER2 NVT"))
def test_restart_with_a_barostat_of_openmm(box, label):
    """A checkpoint brings the random numbers of the barostat.

    It does not bring the count of steps since its last move nor the acceptance ratio of its last ten, with integrators
    of OpenMM either, so that a restart is exact from a multiple of its frequency on, for ten moves.
    """
    _, system, point = box
    system = with_barostat(system, 2)
    # On Reference all random numbers come from one generator, which the integrator's seed starts.
    context = context_at(system, seeded(MAKERS[label]()), point, steps=4)
    volume = context.getState().getPeriodicBoxVolume()
    # Eight moves, of which half are to a smaller box.
    assert_restart_is_the_same(system, context, seeded(MAKERS[label]()), 17)
    assert context.getState().getPeriodicBoxVolume() != volume


# --- what is believed -------------------------------------------------------------------------------------------


@every_integrator
def test_reinitialization_with_its_state_changes_nothing(cluster, make):
    _, system, point = cluster
    ends = []
    for interrupted in (False, True):
        integrator = make()
        context = context_at(system, integrator, point, steps=10)
        if interrupted:
            context.reinitialize(preserveState=True)
        integrator.step(10)
        ends.append(everything(context))
    assert_same(*ends)


def test_noise_is_not_used_again_after_the_state_of_the_start_was_loaded(cluster):
    """A State of before the first step has no bodies in it, but the Context has used noise since."""
    _, system, point = cluster
    integrator = langevin(SIER2)
    context = context_at(system, integrator, point)
    start = full_state(context)
    integrator.step(3)
    context.setState(start)
    context.reinitialize(preserveState=True)
    assert integrator.impl.tally.draws == 3


def test_a_state_of_linear_molecules_keeps_their_axes_where_they_are_in_another_box():
    """GPU platforms bring molecules of a State into the box, which rounds positions.

    Noise is drawn along the axes of a body, of which a linear one has two that its atoms do not show.
    """
    system = openmm.System()
    for mass in (14.0, 1.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.1)
    point = np.array([[0.01, 0.02, 0.03], [0.07, 0.1, 0.03]]), np.array([[0.3, 0.1, 0.2], [0.4, 0.025, -1.0]])
    one, two = seeded(langevin(SIER2)), seeded(langevin(SIER2))
    context, other = context_at(system, one, point, steps=3), openmm.Context(system, two, platform())
    other.setState(full_state(context))
    shift = 7.3
    other.setPositions(phase_point(other)[0] + shift)
    for integrator in (one, two):
        integrator.step(3)
    positions, velocities = (np.subtract(*pair) for pair in zip(phase_point(other), phase_point(context), strict=True))
    # Rounding of 1e-15 nm of positions, and of 1e-14 of angles, beside noise of 0.1 nm/ps.
    assert np.abs(positions - shift).max() < 1e-13
    assert np.abs(velocities).max() < 1e-11


def test_reinitialization_without_its_state_starts_again(cluster):
    _, system, point = cluster
    integrator = langevin(SIER2)
    context = context_at(system, integrator, point, steps=10)
    end = everything(context)
    context.reinitialize()
    context.setPositions(point[0])
    context.setVelocities(point[1])
    assert integrator.getHeat() == 0 * unit.kilojoule_per_mole
    integrator.step(10)
    assert_same(everything(context), end)


def test_noise_after_a_state_is_of_its_own(cluster):
    """Of replicas that share a Context, and of Contexts with other seeds; a seed of 0 is another one each time.

    Trajectories under the same noise grow together (Sindhikara et al., J. Chem. Theory Comput. 5, 1624 (2009)).
    """
    _, system, point = cluster
    integrator = langevin(SIER2)
    context = context_at(system, integrator, point, steps=5)
    saved = full_state(context)
    ends, draws = [], []
    for _ in range(3):
        context.setState(saved)
        integrator.step(5)
        ends.append(integrator.getBodyState())
        draws.append(integrator.impl.tally.draws)
    assert draws == [10, 15, 20]
    for seed in (1, 2, 0, 0):
        other = seeded(langevin(SIER2), seed)
        context = openmm.Context(system, other, platform())
        context.setState(saved)
        other.step(5)
        ends.append(other.getBodyState())
    for one, two in combinations(ends, 2):
        assert np.abs(one.p - two.p).max() > 0.1


OTHERS = [
    lambda: openmm.VerletIntegrator(0.001),
    lambda: openmm.LangevinMiddleIntegrator(297.0, 1.0, 0.001),
    lambda: openmm.NoseHooverIntegrator(297.0, 1.0, 0.001),
    lambda: constrained_velocity_verlet(0.001),
]


@pytest.mark.parametrize("make", OTHERS, ids=["Verlet", "LangevinMiddle", "NoseHoover", "Custom"])
def test_states_of_other_integrators_are_taken_over(tmp_path, box, make):
    """Equilibrate with one, save, continue with the other: OpenMM alone fails on the first one's parameters."""
    topology, system, point = box
    one = simulation_of(topology, with_barostat(system, 25), make(), "CPU", point)
    one.step(5)
    one.context.setParameter(openmm.MonteCarloBarostat.Pressure(), 7.0)
    one.saveState(str(tmp_path / "state"))
    integrator = SIERIntegrator(0.001, "SIER2")
    two = simulation_of(topology, with_barostat(system, 25), integrator, "CPU")
    two.loadState(str(tmp_path / "state"))
    assert_same(everything(two.context)[:5], (*phase_point(one.context), *clock_and_box(one.context)))
    assert two.context.getParameter(openmm.MonteCarloBarostat.Pressure()) == 7.0
    fit = integrator.getBodyState()
    assert np.allclose(fit.p.sum(axis=1), momentum(system, phase_point(one.context)[1]), atol=1e-9)
    two.step(5)
    assert two.currentStep == 10


def test_states_of_ours_are_taken_over_by_openmm(tmp_path, cluster):
    topology, system, point = cluster
    one = simulation_of(topology, system, SIERIntegrator(0.001, "SIER2"), point=point)
    one.step(5)
    one.saveState(str(tmp_path / "state"))
    two = simulation_of(topology, system, openmm.VerletIntegrator(0.001))
    two.loadState(str(tmp_path / "state"))
    assert_same(phase_point(two.context), phase_point(one.context))
    two.step(5)
    assert two.currentStep == 10


def momentum(system, velocities):
    return sum(system.getParticleMass(i)._value * velocity for i, velocity in enumerate(velocities))


# --- bodies whose geometry is taken from positions --------------------------------------------------------------


def test_a_state_is_a_restart_point_if_it_has_the_parameters_of_the_integrator():
    """On the CPU platform with one thread, where the rounding of forces depends on when the neighbour list was made."""
    topology, positions, system = periodic_system()
    prepare_system(system)
    topology, system, point = settled("box-59", topology, positions, system)

    def run(get_state=None, writes=False):
        simulation = simulation_of(topology, system, SIERIntegrator(0.006), "CPU", point)
        simulation.step(8)
        state = get_state(simulation.context) if get_state else None
        xml = openmm.XmlSerializer.serialize(state) if writes else None
        simulation.step(8)
        return everything(simulation.context), state, xml

    def look(context):
        return context.getState(positions=True, velocities=True, forces=True, energy=True, parameters=True)

    assert_same(run()[0], run(look, writes=True)[0])
    end, state, _ = run(full_state)
    written, _, xml = run(full_state, writes=True)
    assert_same(written, end)
    for start in (state, openmm.XmlSerializer.deserialize(xml)):
        again = simulation_of(topology, system, SIERIntegrator(0.006), "CPU")
        again.context.setState(start)
        again.step(8)
        assert_same(everything(again.context), end)


@pytest.mark.parametrize(
    ("name", "engine"),
    representatives(
        [
            ("CustomCVForce", "exact"),
            ("CustomCVForce", "native"),
            ("CustomCVForce in ATMForce", "exact"),
            ("ConstantPotentialForce", "exact"),
        ],
        ("CustomCVForce", "exact"),
        ("CustomCVForce", "native"),
    ),
)
def test_forces_within_forces_have_neighbour_lists_of_their_own(box, name, engine):
    """Positions were 2e-7 nm apart when these lists had a past, after the lists were rebuilt at least once."""
    _, system, point = box
    system = contained(system, name)
    prepare_system(system)
    integrator = SIERIntegrator(0.004, engine=engine)
    context = context_at(system, integrator, point, "CPU", steps=60)
    checkpoint = context.createCheckpoint()
    integrator.step(20)
    again = SIERIntegrator(0.004, engine=engine)
    other = context_at(system, again, point, "CPU")
    other.loadCheckpoint(checkpoint)
    again.step(20)
    assert np.array_equal(phase_point(context), phase_point(other))


@pytest.mark.parametrize("name", ["sier_heat", "sier_draws"])
def test_a_state_with_numbers_that_no_run_writes_is_refused(name):
    _, positions, system = cluster_system(2)
    context = context_at(system, langevin(SIER2), (positions, 0 * positions))
    state = openmm.XmlSerializer.serialize(context.getState(positions=True, velocities=True, integratorParameters=True))
    assert f'{name}="0"' in state
    broken = openmm.XmlSerializer.deserialize(state.replace(f'{name}="0"', f'{name}="nan"'))
    with pytest.raises(openmm.OpenMMException, match=f"{name} = nan"):
        context.setState(broken)
    context.getIntegrator().step(1)
    assert np.isfinite(context.getIntegrator().getHeat()._value)
