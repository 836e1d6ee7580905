"""The integrators in OpenMM Contexts: conservation, order, agreement with OpenMM, and what users do to a Context."""

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIER2P3, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from tests.support.seeded import seeded
from tests.support.systems import with_forces
from tests.support.waters import context_at, energies, force_of, periodic_system, phase_point, platform


def test_forces_changed_without_a_trace_can_be_declared(cluster):
    _, system, point = cluster
    pull = openmm.CustomExternalForce("k*x")
    pull.addPerParticleParameter("k")
    pull.addParticle(0, [0.0])
    system = with_forces(system, pull)
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, point, steps=1)
    before = integrator.getBodyState().p.sum(axis=1)[0]
    pull = force_of(system, openmm.CustomExternalForce)
    pull.setParticleParameters(0, 0, [1000.0])
    pull.updateParametersInContext(context)
    integrator.forcesChanged()
    integrator.step(1)
    assert integrator.getBodyState().p.sum(axis=1)[0] - before == pytest.approx(-1.0, rel=1e-6)


#: Times at which `clock_reader` was asked for forces.
SEEN: list[float] = []


def clock_reader(state):
    """No force; an OpenMM PythonForce has to be a function that can be pickled."""
    SEEN.append(state.getTime()._value)
    return 0.0, np.zeros(state.getPositions(asNumpy=True).shape)


def test_clock_runs_for_forces_that_read_it(cluster):
    """A Force that may depend on time, inside a CustomCVForce too, sees the same in one call of step and in many."""
    times = []
    for counts in ((4,), (1, 1, 1, 1)):
        colvar = openmm.CustomCVForce("0*pull")
        colvar.addCollectiveVariable("pull", openmm.PythonForce(clock_reader))
        integrator = SIERIntegrator(0.001, "SIER2")
        _context = context_at(with_forces(cluster[1], colvar), integrator, cluster[2])
        SEEN.clear()
        for count in counts:
            integrator.step(count)
        times.append(sorted(set(SEEN)))
    # The force at the end of a step serves the start of the next.
    assert times[0][-1] == times[1][-1] == pytest.approx(0.004)
    assert len(times[0]) == len(times[1]) == 4


def test_andersen_thermostat_acts(box):
    _, system, point = box
    system = with_forces(system, seeded(openmm.AndersenThermostat(297.0, 1000.0), 4))
    integrator = SIERIntegrator(0.001, "SIER2")
    _context = context_at(system, integrator, (point[0], 0 * point[1]), "CPU", steps=10)
    assert sum(integrator.bodies.kinetic_energies(integrator.getBodyState())) > 100.0


@pytest.mark.thorough
@pytest.mark.parametrize("model", ["tip4pew", "ions"])
def test_stock_simulation_with_stock_reporters(tmp_path, model):
    mdtraj = pytest.importorskip("mdtraj")
    ions = model == "ions"
    topology, positions, system = periodic_system("tip3p" if ions else model, 216 if ions else 64, ions)
    if ions:
        assert {r.name for r in topology.residues()} == {"HOH", "NA", "CL"}
    simulation = app.Simulation(topology, system, SIERIntegrator(0.001, "SIER2"), platform("CPU"), {"Threads": "1"})
    simulation.context.setPositions(positions)
    simulation.minimizeEnergy(maxIterations=50)
    simulation.context.setVelocitiesToTemperature(297.0, 1)
    log = tmp_path / "log.csv"
    simulation.reporters += [
        app.DCDReporter(str(tmp_path / "t.dcd"), 5),
        app.XTCReporter(str(tmp_path / "t.xtc"), 5),
        app.PDBReporter(str(tmp_path / "t.pdb"), 10),
        app.CheckpointReporter(str(tmp_path / "t.chk"), 10),
        app.StateDataReporter(str(log), 5, step=True, temperature=True, totalEnergy=True),
        mdtraj.reporters.HDF5Reporter(str(tmp_path / "t.h5"), 5, velocities=True),
    ]
    simulation.step(20)
    simulation.reporters[-1].close()
    assert simulation.currentStep == 20
    simulation.reporters.clear()
    rows = np.genfromtxt(log, delimiter=",", names=True)
    assert rows["Step"].tolist() == [5, 10, 15, 20]
    assert mdtraj.load(str(tmp_path / "t.h5")).n_frames == 4
    assert mdtraj.load(str(tmp_path / "t.dcd"), top=str(tmp_path / "t.pdb")).n_frames == 4


def test_steps_without_a_context_are_refused():
    with pytest.raises(openmm.OpenMMException, match="no Context"):
        SIERIntegrator(0.001, "SIER2").step(1)


@pytest.mark.parametrize("steps", [-1, 2.5, float("nan"), "3", None])
def test_impossible_step_counts(cluster, steps):
    _, system, point = cluster
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, point)
    with pytest.raises((ValueError, TypeError), match="steps"):
        integrator.step(steps)
    assert context.getStepCount() == 0


@pytest.mark.parametrize("size", [-0.001, float("nan"), float("inf"), "long", 1 * unit.nanometer])
def test_impossible_step_sizes(size):
    with pytest.raises((ValueError, TypeError), match="stepSize"):
        SIERIntegrator(size, "SIER2")
    integrator = SIERIntegrator(0.001, "SIER2")
    with pytest.raises((ValueError, TypeError), match="stepSize"):
        integrator.setStepSize(size)
    assert integrator.getStepSize() == 0.001 * unit.picosecond


@pytest.mark.parametrize("make", [lambda: SIERIntegrator(0, "SIER2"), lambda: SIERLangevinIntegrator(300, 1, 0)])
def test_a_step_of_zero_moves_nothing(cluster, make):
    """OpenMM's users give it to the integrators of Contexts that only evaluate forces."""
    _, system, point = cluster
    integrator = make()
    context = context_at(system, integrator, point)
    assert np.isfinite(energies(context)).all()
    before = integrator.getBodyState()
    integrator.step(3)
    # The atoms are placed anew on their bodies: SETTLE left them up to 5e-9 nm off.
    assert phase_point(context)[0] == pytest.approx(point[0], abs=1e-8)
    after = integrator.getBodyState()
    assert all(np.array_equal(getattr(after, name), getattr(before, name)) for name in "qpL")
    assert (context.getStepCount(), context.getTime()) == (3, 0 * unit.picosecond)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "barostat",
    [
        openmm.MonteCarloBarostat(1e5, 297.0, 3),
        openmm.MonteCarloAnisotropicBarostat(1e5 * openmm.Vec3(1, 1, 1), 297.0, True, True, True, 3),
        openmm.MonteCarloMembraneBarostat(1e5, 0.0, 297.0, 0, 0, 3),
    ],
    ids=lambda barostat: type(barostat).__name__,
)
def test_barostats_need_no_velocities(box, barostat):
    """Where barostats alone act on the Context, it is read back only after they did: to the bit the same trajectory.

    With the general way, which writes everything before and reads everything after each of OpenMM's steps. At 10^5 bar
    each move to a smaller box is accepted.
    """
    _, system, point = box
    system = with_forces(system, seeded(barostat, 7))
    # A CMMotionRemover's work is rounded differently in the two ways.
    system.removeForce([force.getName() for force in system.getForces()].index("CMMotionRemover"))
    ends, volumes = [], []
    for alone in (True, False):
        # On Reference all random numbers come from one generator, which the integrator's seed starts.
        integrator = seeded(SIERIntegrator(0.001, "SIER2"), 7)
        context = context_at(system, integrator, point)
        volumes.append(context.getState().getPeriodicBoxVolume()._value)
        integrator.step(0)
        assert integrator.impl.engine.updates.are_of_barostats
        integrator.impl.engine.updates.are_of_barostats = alone
        integrator.step(60)
        ends.append(phase_point(context))
        volumes.append(context.getState().getPeriodicBoxVolume()._value)
    assert np.array_equal(*ends)
    assert volumes[1] == volumes[3] != volumes[0]


@pytest.mark.parametrize(
    "make",
    [
        lambda scheme: SIERIntegrator(0.001, scheme),
        lambda scheme: SIERLangevinIntegrator(300, 1, 0.001, scheme),
        lambda scheme: SIERHMCIntegrator(300, 0.001, scheme),
    ],
)
def test_a_scheme_may_be_given_by_its_name(make):
    for name in ("SIER2P3", "sier2p3", "Sier2P3"):
        assert make(name).scheme == make(SIER2P3).scheme
    with pytest.raises(ValueError, match=r"scheme .*SIER2, .*'verlet'"):
        make("verlet")
    with pytest.raises(TypeError, match=r"scheme .*SIERIntegrator.*, got 4"):
        make(4)


def test_print_has_scheme_step_and_engine(cluster):
    _, system, point = cluster
    integrator = SIERLangevinIntegrator(300, 5, 0.009)
    assert str(integrator) == "<SIERLangevinIntegrator: SIER2 in steps of 9 fs, engine auto>"
    _context = context_at(system, integrator, point)
    assert str(integrator) == "<SIERLangevinIntegrator: SIER2 in steps of 9 fs, engine exact>"
