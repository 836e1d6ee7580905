"""Changes of a Context between steps act from the next step on, and impossible ones are refused."""

from functools import partial

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import SIER2, SIER4, SIER4G, SIERHMCIntegrator, SIERIntegrator, prepare_system
from openmm_sier.engines import trials
from openmm_sier.ensembles import metropolis
from openmm_sier.stability.runaway import RunawayError
from tests.support.peptides import capped_alanine
from tests.support.systems import assembled, field
from tests.support.waters import cluster_system, context_at, force_of, phase_point, platform, settled

both_engines = pytest.mark.parametrize("engine", ["exact", "native"])

#: nm. Two Contexts at the same place differ by rounding: the exact engine takes its bodies' momenta from the velocities
#: of their atoms, which costs 1e-15, and this grows in a few steps no further. A wrong force displaces by 1e-4.
SAME = 1e-11


def stretched(context):
    """A box that is larger by 2 %, in which atoms stay where they are."""
    edges = 1.02 * np.array(context.getState().getPeriodicBoxVectors()._value)
    context.setPeriodicBoxVectors(*edges)


def sheared(context):
    vectors = np.array(context.getState().getPeriodicBoxVectors()._value)
    vectors[1, 0] = 0.02 * vectors[0, 0]
    context.setPeriodicBoxVectors(*vectors)


def a_state_without_positions(context):
    """Which has a box nevertheless."""
    other = openmm.Context(context.getSystem(), openmm.VerletIntegrator(0.001), platform())
    other.setTime(context.getTime())
    stretched(other)
    context.setState(other.getState())


def other_charges(context):
    force = force_of(context.getSystem())
    for i in range(force.getNumParticles()):
        charge, sigma, epsilon = force.getParticleParameters(i)
        force.setParticleParameters(i, 0.9 * charge, sigma, epsilon)
    force.updateParametersInContext(context)


CHANGES = (sheared, a_state_without_positions, other_charges)


@both_engines
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_change_acts_from_the_next_step_on(box, engine, change):
    """As in a Context that is new, and that has no forces of earlier steps."""
    _, plain, point = box
    ends = []
    for is_new in (False, True):
        system = openmm.XmlSerializer.clone(plain)
        context = context_at(system, SIERIntegrator(0.002, SIER2, engine=engine), point, steps=3)
        if is_new:
            context = context_at(system, SIERIntegrator(0.002, SIER2, engine=engine), phase_point(context))
        change(context)
        context.getIntegrator().step(2)
        ends.append(phase_point(context)[0])
    assert np.abs(ends[0] - ends[1]).max() < SAME


@both_engines
def test_virtual_sites_need_not_be_placed(engine):
    """Positions for atoms alone are enough, as files without virtual sites give them."""
    _, system, (positions, velocities) = settled("cluster-4-tip4pew", *cluster_system(4, "tip4pew"))
    sites = [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]
    elsewhere = positions.copy()
    elsewhere[sites] = 0.0
    ends = [
        phase_point(context_at(system, SIERIntegrator(0.002, SIER2, engine=engine), (start, velocities), steps=3))[0]
        for start in (positions, elsewhere)
    ]
    # Positions in the fixture are rounded by the CPU platform, to 1e-7 nm, virtual sites among them.
    assert np.abs(ends[0] - ends[1]).max() < 1e-6


# --- what is not finite -----------------------------------------------------------------------------------------------


@both_engines
@pytest.mark.parametrize(("which", "value"), [(0, np.nan), (1, np.nan), (1, np.inf)])
def test_positions_and_velocities_must_be_finite(cluster, engine, which, value):
    _, system, point = cluster
    context = context_at(system, SIERIntegrator(0.002, SIER2, engine=engine), point, steps=2)
    vectors = phase_point(context)
    vectors[which][4, 1] = value
    context.setPositions(vectors[0])
    context.setVelocities(vectors[1])
    name = ("position", "velocit")[which] + (".* of the body of atoms" if engine == "exact" else "")
    for _ in range(2):
        with pytest.raises((openmm.OpenMMException, ValueError), match=rf"(?i){name}.*not finite"):
            context.getIntegrator().step(1)
    assert context.getStepCount() == 2
    # With others the run goes on.
    context.setPositions(point[0])
    context.setVelocities(point[1])
    context.getIntegrator().step(1)
    assert np.isfinite(phase_point(context)[0]).all()


@both_engines
def test_a_run_that_ends_in_no_numbers_says_so(engine):
    """Also one of few atoms, whose heat is not judged, and on the Reference platform, which computes on."""
    system = assembled([16.0], field("100*sqrt(0.1 - x)", [0]))
    result = SIERIntegrator(0.002, SIER2, engine=engine)
    context = context_at(system, result, (np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]])))
    with pytest.raises((RunawayError, openmm.OpenMMException), match="not finite"):
        context.getIntegrator().step(200)


@both_engines
@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G], ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("make", [SIERIntegrator, partial(SIERHMCIntegrator, 300.0, stepsPerTrial=30)])
def test_no_force_is_computed_where_atoms_are_lost(engine, make, scheme, monkeypatch):
    """On Reference, whose PME writes outside of its mesh there, which ends the process."""
    seen = []

    def force(state):
        positions = state.getPositions(asNumpy=True)._value
        seen.append(np.isfinite(positions).all())
        return 0.0, np.full(positions.shape, np.nan if positions[0, 0] > 0.1 else 0.0)

    periodic = openmm.PythonForce(force)
    periodic.setUsesPeriodicBoundaryConditions(True)
    integrator = make(0.002, scheme=scheme, engine=engine)
    _context = context_at(assembled([16.0], periodic), integrator, (np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]])))
    # The atom meets the place where the force is no number within 25 steps; a trial goes there and is rejected.
    for module in (metropolis, trials):
        monkeypatch.setattr(module, "draw_start", lambda *_: None)
    if make is SIERIntegrator:
        with pytest.raises(openmm.OpenMMException, match=r"not finite in step 2\d"):
            integrator.step(60)
    else:
        integrator.step(1)
        assert (integrator.trials, integrator.accepted) == (1, 0)
    assert len(seen) > 20
    assert all(seen)


@both_engines
@pytest.mark.parametrize("mass", [-0.1, np.nan, np.inf])
def test_impossible_masses_are_refused(engine, mass):
    system = assembled([mass, 1.0])
    with pytest.raises(openmm.OpenMMException, match="mass of particle 0"):
        openmm.Context(system, SIERIntegrator(0.002, SIER2, engine=engine), platform())


# --- where no minimization can begin ----------------------------------------------------------------------------------


def on_its_neighbour(positions):
    """The first molecule where the second is."""
    positions[3:6] = positions[:3]


def on_its_own_atom(positions):
    """A hydrogen where its oxygen is, so that no direction is left for the constraint."""
    positions[1] = positions[0]


@both_engines
@pytest.mark.parametrize(
    ("overlap", "named"),
    [
        (on_its_neighbour, r"energy is .* atom 0 \(0 nm from atom 3\)"),
        (on_its_own_atom, r"constraints of atom 0 \(0 nm"),
    ],
    ids=["molecules", "atoms of a molecule"],
)
def test_a_minimization_that_would_never_end_is_refused(cluster, engine, overlap, named, monkeypatch):
    """OpenMM's minimizer does not end if the energy is not a number."""
    topology, system, point = cluster
    get_state = openmm.Context.getState

    def at_finite_positions(context, *arguments, energy=False, **named):
        # PME of Reference writes outside of its mesh elsewhere.
        assert not energy or np.isfinite(get_state(context, positions=True).getPositions(asNumpy=True)._value).all()
        return get_state(context, *arguments, energy=energy, **named)

    monkeypatch.setattr(openmm.Context, "getState", at_finite_positions)
    simulation = app.Simulation(topology, system, SIERIntegrator(0.002, SIER2, engine=engine), platform())
    positions = point[0].copy()
    overlap(positions)
    simulation.context.setPositions(positions)
    with pytest.raises(openmm.OpenMMException, match=named):
        simulation.minimizeEnergy(maxIterations=1)
    assert np.array_equal(phase_point(simulation.context)[0], positions)
    simulation.context.setPositions(point[0])
    simulation.minimizeEnergy(maxIterations=1)


def test_a_slow_force_changes_no_operators_and_no_bonds():
    """Which are made of all fast terms and all bonds: metadynamics changes a slow Force hundreds of times."""
    system, positions = capped_alanine(4)
    prepare_system(system)
    pull = field("k*z^2", range(8), k=1.0)
    system.addForce(pull)
    context = openmm.Context(system, SIERIntegrator(0.001, engine="exact"), platform())
    context.setPositions(positions)
    integrator = context.getIntegrator()
    integrator.step(1)
    engine = integrator.impl.engine
    motion, bonds = engine.motion, engine._bonds
    pull.updateParametersInContext(context)
    integrator.step(1)
    assert engine.motion is motion
    assert engine._bonds is bonds
    force_of(system, openmm.HarmonicBondForce).updateParametersInContext(context)
    integrator.step(1)
    assert engine.motion is not motion


@pytest.mark.parametrize("changed", [openmm.HarmonicAngleForce, openmm.HarmonicBondForce])
def test_a_fast_force_stays_fast_until_the_context_is_made_again(changed):
    """OpenMM keeps the groups with which it made a Context, and every Force acts once."""
    system, positions = capped_alanine(4)
    prepare_system(system)
    angles = force_of(system, openmm.HarmonicAngleForce)
    ends = []
    for group in (1, 2):
        angles.setForceGroup(1)
        integrator = SIERIntegrator(0.0002, fastForceGroups={1}, engine="exact", substeps=2)
        context = openmm.Context(system, integrator, platform())
        context.setPositions(positions)
        integrator.step(1)
        angles.setForceGroup(group)
        force_of(system, changed).updateParametersInContext(context)
        integrator.step(2)
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
    assert np.abs(ends[0] - ends[1]).max() < SAME
