"""The native engine: OpenMM executes the integrator's program, with SETTLE and SHAKE in place of the exact rotation."""

import copy

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER2V2, SIER4, SIER4G, RigidBodies, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.rotation import mrdl
from tests.support.restarts import full_state
from tests.support.seeded import seeded
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, context_at, periodic_system, phase_point, settled

MODELS = ["tip3p", "tip4pew"]


@pytest.fixture(scope="module", params=MODELS)
def cluster(request):
    return settled(f"cluster-3-{request.param}", *cluster_system(3, request.param))[1:]


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_barostat_and_motion_remover_count_whole_steps(engine):
    _, system, point = settled("box-59", *periodic_system())
    for force in system.getForces():
        if isinstance(force, openmm.CMMotionRemover):
            force.setFrequency(4)
    # At 10^5 bar each move to a smaller box is accepted. The integrator's seed starts all random numbers of Reference.
    system.addForce(openmm.MonteCarloBarostat(1e5, 297.0, 3))
    context = context_at(system, integrator := seeded(SIERIntegrator(0.001, SIER2, engine=engine)), point)
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])

    def drift():
        return np.abs(masses @ phase_point(context)[1]).max() / masses.sum()

    boxes, resting = [], []
    for _ in range(12):
        integrator.step(1)
        boxes.append(context.getState().getPeriodicBoxVolume()._value)
        context.setVelocities(phase_point(context)[1] + [0.01, 0.0, 0.0])
        resting.append(drift())
    changed = [i + 1 for i in range(1, 12) if boxes[i] != boxes[i - 1]]
    assert set(changed) <= {3, 6, 9, 12}
    assert changed
    # The remover acts at the start of a step whose number is a multiple of 4: after steps 1, 5 and 9 only the velocity
    # that was added last is left.
    low = [i + 1 for i in range(12) if resting[i] < 0.011]
    assert low == [1, 5, 9]


@pytest.mark.parametrize("scheme", [SIER2, SIER4G])
def test_counting_heat_changes_no_trajectory(cluster, scheme):
    """Drifts remove components along constraints. At 0 K, since Reference draws noise for each statement."""
    system, point = cluster
    ends = []
    for counts in (True, False):
        integrator = SIERLangevinIntegrator(0, 20, 0.004, scheme, engine="native", countsHeat=counts)
        context = context_at(system, integrator, point, steps=6)
        ends.append(phase_point(context))
    assert np.abs(ends[0][0] - point[0]).max() > 1e-3
    # SETTLE leaves 5e-9 nm in each of some ten substeps of a step, and velocities move by that in 1 fs.
    assert np.abs(ends[0][0] - ends[1][0]).max() < 5e-7
    assert np.abs(ends[0][1] - ends[1][1]).max() < 1e-3


@pytest.mark.parametrize("counts_heat", [True, False])
def test_step_of_a_bath_is_that_of_langevin_middle(cluster, counts_heat):
    """OpenMM's integrator, too, constrains positions once for both halves of a drift with a bath in its middle.

    At 0 K, since the integrators draw their noise in another order.
    """
    system, point = cluster
    own = SIERLangevinIntegrator(0, 20, 0.004, SIER2, engine="native", countsHeat=counts_heat)
    other = openmm.LangevinMiddleIntegrator(0, 20, 0.004)
    other.setConstraintTolerance(1e-9)
    results, expected = (phase_point(context_at(system, integrator, point, steps=6)) for integrator in (own, other))
    assert np.abs(expected[0] - point[0]).max() > 1e-3
    # Rounding; SETTLE's single precision is the same for both. A solution of the constraints more, another time over
    # which they change velocities, or velocities that are not constrained first move atoms by 8e-5 nm and more.
    assert np.abs(results[0] - expected[0]).max() < 1e-12


def test_cold_bath_slows_bodies_exactly():
    """Without forces the velocities of bodies decay as exp(-friction t), the noise of 0 K being zero."""
    _topology, positions, system = cluster_system(2)
    for i in reversed(range(system.getNumForces())):
        system.removeForce(i)
    point = (positions, np.tile([1.0, 2.0, 3.0], (len(positions), 1)))
    integrator = SIERLangevinIntegrator(0, 10, 0.004, SIER4G, engine="native")
    context = context_at(system, integrator, point, steps=5)
    # Rounding of 10 factors; SETTLE moves velocities by its 5e-9 nm over a substep of 1 fs.
    assert phase_point(context)[1] == pytest.approx(point[1] * np.exp(-10 * 0.02), rel=2e-5)
    integrator.setFriction(0)
    before = phase_point(context)[1]
    integrator.step(5)
    assert phase_point(context)[1] == pytest.approx(before, rel=2e-5)


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        ({"rotation": mrdl}, "has only the exact free-rotation map: leave out `rotation`"),
        ({"rigid": [[0, 1, 2], [3, 4]]}, "no constraint joins atoms 3 and 4 .* with_frames"),
        ({"rotationalFriction": 5}, "leave out `rotationalFriction`"),
    ],
)
def test_what_only_the_exact_engine_has_is_refused(settings, remedy):
    _, _, waters = cluster_system(1)
    constrained = [waters.getConstraintParameters(i) for i in range(waters.getNumConstraints())]
    system = assembled((16.0, 1.0, 1.0, 30.0, 40.0), constraints=constrained)
    if rigid := settings.pop("rigid", None):
        positions = np.random.default_rng(1).random((5, 3))
        settings["bodies"] = RigidBodies.from_system(system, rigid=rigid, positions=positions)
    langevin = "rotationalFriction" in settings
    arguments = (300, 1, 0.002) if langevin else (0.002,)
    integrator = (SIERLangevinIntegrator if langevin else SIERIntegrator)(*arguments, **settings, engine="native")
    with pytest.raises(openmm.OpenMMException, match=remedy + ".*engine='exact'"):
        openmm.Context(system, integrator)


def test_named_bodies_that_constraints_hold_are_taken(cluster):
    system, point = cluster
    size = len(point[0]) // 3
    for rigid in ([[0, 1, 2]], [list(range(size))], None):
        bodies = RigidBodies.from_system(system, rigid=rigid, positions=point[0])
        integrator = SIERIntegrator(0.002, bodies=bodies, engine="native")
        context_at(system, integrator, point)
        assert integrator.engine == "native"


def test_setters_refuse_what_the_constructor_refuses_and_change_nothing(cluster):
    system, point = cluster
    integrator = SIERLangevinIntegrator(300, 1, 0.002, engine="native")
    context = context_at(system, integrator, point, steps=1)
    with pytest.raises(openmm.OpenMMException):
        integrator.setRotationalFriction(50)
    assert (integrator.getFriction()._value, integrator.getRotationalFriction()._value) == (1, 1)
    integrator.setRotationalFriction(1)
    with pytest.raises(openmm.OpenMMException):
        integrator.setFriction(2)
    assert integrator.getFriction()._value == 1
    integrator.step(1)
    assert context.getStepCount() == 2


def test_andersen_thermostat_is_refused_beside_bodies_without_constraints(cluster):
    """It hits single atoms. Where constraints join them OpenMM hits all of a body."""
    system, point = cluster
    atoms = [[0, 1, 2]]
    bodies = RigidBodies.from_system(system, rigid=atoms, positions=point[0])
    andersen = with_forces(system, openmm.AndersenThermostat(300, 1))
    context_at(andersen, SIERIntegrator(0.002, engine="exact"), point)
    while andersen.getNumConstraints():
        andersen.removeConstraint(0)
    with pytest.raises(openmm.OpenMMException, match=r"AndersenThermostat.*SIERLangevinIntegrator"):
        context_at(andersen, SIERIntegrator(0.002, bodies=bodies, engine="exact"), point)


def test_andersen_thermostat_is_refused(cluster):
    system, point = cluster
    system = with_forces(system, openmm.AndersenThermostat(300, 1))
    with pytest.raises(openmm.OpenMMException, match=r"AndersenThermostat.*SIERLangevinIntegrator"):
        context_at(system, SIERIntegrator(0.002, engine="native"), point)


# --- from one engine to the other ---


@pytest.mark.parametrize("first", ["exact", "native"])
@pytest.mark.parametrize("by", ["checkpoint", "state"])
def test_runs_continue_with_the_other_engine(cluster, first, by):
    system, point = cluster
    second = {"exact": "native", "native": "exact"}[first]
    one, other = (
        seeded(SIERLangevinIntegrator(300, 10, 0.002, SIER4, engine=engine, substeps=5)) for engine in (first, second)
    )
    context, later = context_at(system, one, point), context_at(system, other, point)
    one.step(7)
    heat = one.getHeat()._value
    if by == "checkpoint":
        later.loadCheckpoint(context.createCheckpoint())
    else:
        later.setState(full_state(context))
    for before, after in zip(phase_point(context), phase_point(later), strict=True):
        assert (before == after).all()
    assert later.getStepCount() == 7
    assert heat != 0
    assert other.getHeat()._value == pytest.approx(heat, rel=1e-12)
    if second == "native":
        # Nothing is moved onto constraints that it satisfies. The exact engine moves atoms onto its bodies, by 5e-9 nm.
        other.step(0)
        assert (phase_point(later)[0] == phase_point(context)[0]).all()
    for integrator in (one, other):
        integrator.setFriction(0)
        integrator.step(3)
    # Five substeps are exact to 1e-7 nm, see above.
    assert np.abs(phase_point(later)[0] - phase_point(context)[0]).max() < 1e-6


@pytest.mark.parametrize(("first", "second"), [("Reference", "CPU"), ("CPU", "Reference")])
def test_runs_continue_on_another_platform(first, second):
    """Whose program divides a step into another number of native steps."""
    _, system, point = settled("box-59", *periodic_system())
    one, other = (SIERIntegrator(0.002, SIER2V2, engine="native") for _ in range(2))
    context, later = context_at(system, one, point, first), context_at(system, other, point, second)
    assert len(one.program.parts) != len(other.program.parts)
    one.step(3)
    later.setState(full_state(context))
    copied = copy.deepcopy(other)
    for integrator in (one, other):
        integrator.setStepSize(0.001)
        integrator.step(3)
    assert later.getStepCount() == 6
    assert later.getTime()._value == pytest.approx(0.009, abs=1e-12)
    assert copied.getStepSize()._value == 0.002
    # Forces in single precision are off by 1e-5 of up to 1e4 kJ/mol/nm, which move hydrogen by 1e-6 nm in 3 fs. Steps
    # of another length leave atoms 1e-3 nm away.
    assert np.abs(phase_point(later)[0] - phase_point(context)[0]).max() < 1e-5


# --- what users do to a Context ---


def test_atoms_set_off_their_constraints_are_moved_onto_them(cluster):
    """As by `Context.applyConstraints`, before the first step and at any time later."""
    system, (positions, velocities) = cluster
    rng = np.random.default_rng(3)
    off = positions + rng.uniform(-2e-3, 2e-3, positions.shape), velocities + rng.normal(size=velocities.shape)
    integrators = [SIERIntegrator(0.001, SIER2, engine="native") for _ in range(2)]
    contexts = [context_at(system, integrator, off) for integrator in integrators]
    for again in (False, True):
        if again:
            for context in contexts:
                context.setPositions(off[0])
                context.setVelocities(off[1])
        for context in contexts:
            context.computeVirtualSites()
        contexts[1].applyConstraints(1e-9)
        contexts[1].applyVelocityConstraints(1e-9)
        for integrator in integrators:
            integrator.step(1)
        one, other = (phase_point(context) for context in contexts)
        # The same operations. Left to the first step they are others: it changes velocities along the constraints as
        # they are then, which differ by 2 %.
        assert np.abs(one[1] - other[1]).max() < 1e-9


def test_positions_that_were_never_set():
    """They are zeros, of which a body's shape is not to blame."""
    integrator = SIERIntegrator(0.001, engine="native")
    context = openmm.Context(cluster_system(3)[2], integrator, openmm.Platform.getPlatformByName("Reference"))
    for ask in (integrator.getBodyState, integrator.computeTemperatures, lambda: integrator.step(1)):
        with pytest.raises(openmm.OpenMMException, match="Particle positions have not been set"):
            ask()
    assert context.getStepCount() == 0
