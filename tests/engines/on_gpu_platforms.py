"""What must hold on CUDA, HIP and OpenCL. `test_gpu_platforms` runs this module where there is one of them.

Few Contexts are made here: OpenMM compiles some hundred kernels for each, which takes 6 s on a CPU.
"""

import functools
import math

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    SIER2V2,
    SIER4G,
    SIER4P,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    with_frames,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.native import installation
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.program import KEPT
from openmm_sier.ensembles import metropolis
from openmm_sier.inputs.equilibration import make_context
from tests.support import anharmonic, opencl, spinning
from tests.support.commands import log, run, write_lattice
from tests.support.ethane import ethane
from tests.support.framed import moved, polar, system_of
from tests.support.restarts import full_state
from tests.support.seeded import seeded
from tests.support.systems import assembled
from tests.support.types import PATCHY, typed
from tests.support.waters import cluster_system, context_at, energies, periodic_system, phase_point, platform, settled


@pytest.fixture(scope="module", params=opencl.gpu_platforms())
def gpu(request):
    return request.param


@pytest.fixture(scope="module")
def cluster():
    """Three molecules with virtual sites."""
    return settled("cluster-3-tip4pew", *cluster_system(3, "tip4pew"))[1:]


def gpu_context(gpu, precision, system, integrator, point):
    context = openmm.Context(system, integrator, platform(gpu), {"Precision": precision})
    context.setPositions(point[0])
    context.setVelocities(point[1])
    return context


@pytest.fixture(scope="module")
def in_precision(gpu, cluster):
    """The cluster's Context in a precision, and its integrator."""

    @functools.cache
    def make(precision):
        integrator = SIERIntegrator(0.004, SIER4G, engine="native")
        return gpu_context(gpu, precision, cluster[0], integrator, cluster[1]), integrator

    return make


@pytest.mark.parametrize(("precision", "error"), [("double", 1e-7), ("single", 1e-4)])
def test_program_moves_atoms_as_on_reference(in_precision, cluster, precision, error):
    system, point = cluster
    (context, integrator), reference = in_precision(precision), SIERIntegrator(0.004, SIER4G, engine="native")
    expected = context_at(system, reference, point)
    assert integrator.engine == "native"
    assert integrator.impl.engine.precision == precision
    integrator.step(10)
    reference.step(10)
    assert context.getStepCount() == 10
    assert context.getTime()._value == pytest.approx(0.04, abs=1e-15)
    # SETTLE works in single precision for lengths, 5e-9 nm a substep; positions of single precision are good to
    # 1e-7 nm, from which each substep takes velocities. A virtual site that stayed behind moves atoms by 1e-3 nm in
    # this time.
    assert np.abs(phase_point(context)[0] - phase_point(expected)[0]).max() < error
    assert integrator.getConstraintTolerance() == (1e-6 if precision == "single" else 1e-9)
    assert integrator.computeSystemTemperature()._value == pytest.approx(
        reference.computeSystemTemperature()._value, rel=max(1e-4, 100 * error)
    )


def test_fourth_order_in_double_precision(in_precision, cluster):
    system, point = cluster
    exact = context_at(system, SIERIntegrator(0.0005, SIER4P, engine="exact"), point, steps=64)
    context, integrator = in_precision("double")
    errors = []
    for steps in (8, 16):
        integrator.setStepSize(0.032 / steps)
        context.setPositions(point[0])
        context.setVelocities(point[1])
        integrator.step(steps)
        errors.append(np.abs(phase_point(context)[0] - phase_point(exact)[0]).max())
    # 16 in the limit and 4 in a program of second order. The next term of the error is a tenth of the first at 4 fs.
    assert 14 < errors[0] / errors[1] < 19


def test_constant_pressure_and_both_ways_between_the_engines(gpu):
    _, system, point = settled("box-tip4pew", *periodic_system("tip4pew"))
    # At 10^5 bar each move to a smaller box is accepted.
    system.addForce(seeded(openmm.MonteCarloBarostat(1e5 * unit.bar, 300 * unit.kelvin, 2), 1))
    result = [SIERLangevinIntegrator(300, 5, 0.004, SIER4G, countsHeat=True) for _ in range(3)]
    on_cpu, on_gpu, again = (seeded(each, 1) for each in result)
    first = context_at(system, on_cpu, point, "CPU", steps=3)
    context = gpu_context(gpu, "mixed", system, on_gpu, point)
    context.setState(full_state(first))
    assert on_cpu.engine == "exact"
    # Where the package openmm-sier-kernels is installed, it moves the bodies.
    assert on_gpu.engine in ("native", "kernels")
    # Mixed precision keeps positions as two numbers of single precision, 2^-48 of 2 nm, and velocities in double.
    assert np.abs(phase_point(context)[0] - phase_point(first)[0]).max() < 1e-13
    assert (phase_point(context)[1] == phase_point(first)[1]).all()
    # PME in single precision: 1e-5 of the energy.
    assert energies(context)[0] == pytest.approx(energies(first)[0], rel=1e-4)
    volume, total, heat = context.getState().getPeriodicBoxVolume(), sum(energies(context)), on_gpu.getHeat()._value
    on_gpu.step(24)
    assert context.getState().getPeriodicBoxVolume() != volume
    assert context.getStepCount() == 27
    # What barostats do to the energy is not counted: some kT per accepted move, of which there are some six.
    assert sum(energies(context)) - total == pytest.approx(on_gpu.getHeat()._value - heat, abs=60)
    last = context_at(system, again, point, "CPU")
    last.setState(full_state(context))
    assert np.abs(phase_point(last)[0] - phase_point(context)[0]).max() == 0
    assert last.getState().getPeriodicBoxVolume() == context.getState().getPeriodicBoxVolume()
    again.step(2)
    assert last.getStepCount() == 29
    # 354 degrees of freedom: six and a half standard deviations.
    assert again.computeSystemTemperature()._value == pytest.approx(300, abs=150)


def test_heat_is_not_counted_unless_asked_for(gpu):
    """What counts it, and what the exact engine stores, makes kernels slower."""
    _, system, point = settled("box-59", *periodic_system())
    integrator = seeded(SIERLangevinIntegrator(300, 5, 0.004), 1)
    context = gpu_context(gpu, "mixed", system, integrator, point)
    integrator.step(5)
    names = map(integrator.getPerDofVariableName, range(integrator.getNumPerDofVariables()))
    assert list(names) == [KEPT]
    with pytest.raises(openmm.OpenMMException, match="countsHeat=True"):
        integrator.getHeat()
    assert math.isnan(integrator.countedHeat)
    # Velocities are constrained at the end of a step; positions have SETTLE's 5e-9 nm.
    before = phase_point(context)
    context.applyVelocityConstraints(1e-9)
    assert phase_point(context)[1] == pytest.approx(before[1], abs=1e-5)


def test_solutes_in_mixed_precision(gpu):
    """Fast forces in the drift, and constraints that converge to 1e-9, which positions of single precision do not."""
    system, positions = ethane()
    for force in system.getForces():
        force.setForceGroup(isinstance(force, openmm.HarmonicBondForce))
    program = native_program.write(SIER4G, None, {1})
    integrator = openmm.CustomIntegrator(0.002 / len(program.parts))
    installation.install(program, integrator)
    integrator.setConstraintTolerance(1e-9)
    context = gpu_context(gpu, "mixed", system, integrator, (positions, np.zeros((8, 3))))
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(len(program.parts))
    start = sum(energies(context))
    integrator.step(150 * len(program.parts))
    # On Reference the energy stays within 0.002 kJ/mol; forces of mixed precision add 1e-6 of 150 steps. Forces that
    # are twice in the program, or not at all, change it by kT.
    assert sum(energies(context)) == pytest.approx(start, abs=0.02)
    x = phase_point(context)[0]
    pairs = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
    errors = [np.linalg.norm(x[i] - x[j]) - length._value for i, j, length in pairs]
    # OpenMM keeps the lengths in single precision, 2^-25 of 0.109 nm. About these they are good to 1e-9 of it.
    assert np.abs(errors).max() < 4e-9
    assert np.ptp(errors) < 2e-10


def test_trials_sample_exactly(gpu):
    """Half of the first ends are rejected; see `anharmonic`."""
    integrator = seeded(SIERHMCIntegrator(anharmonic.TEMPERATURE, 0.022, SIER2V2, 2, 2.0, extraChances=0), 5)
    x = anharmonic.positions()
    context = gpu_context(gpu, "mixed", anharmonic.system(), integrator, (x, np.zeros_like(x)))
    integrator.step(20)
    assert integrator.impl.engine.makes_trials
    integrator.resetStatistics()
    rows = []
    for _ in range(2000):
        integrator.step(1)
        rows.append(anharmonic.observed(*phase_point(context)))
    assert 0.4 < integrator.acceptanceRate < 0.6
    # Standard errors of 25 blocks, as in `test_whole_trials.py`.
    assert (np.abs(anharmonic.distances(rows)) < 4.5).all()


def test_ends_with_broken_constraints_are_rejected(gpu, monkeypatch):
    monkeypatch.setattr(metropolis, "largest_error", lambda *_: 1e15)
    integrator = seeded(SIERHMCIntegrator(300, spinning.STEP, SIER2, 1, None, extraChances=0, engine="native"), 5)
    context = gpu_context(gpu, "mixed", spinning.system(), integrator, (spinning.POSITIONS, 0 * spinning.POSITIONS))
    assert integrator.impl.engine.makes_trials
    assert 3 < spinning.rejected(context, 60) < 50


def test_virtual_sites_follow_their_atoms_in_trials(gpu, cluster, monkeypatch):
    """Energies of the Context, whose sites are placed, change by the errors of the ends that are accepted."""
    system, point = cluster
    integrator = seeded(SIERHMCIntegrator(300, 0.009, stepsPerTrial=4, extraChances=0), 5)
    context = gpu_context(gpu, "mixed", system, integrator, point)
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
        assert np.array_equal(phase_point(context)[0], start) is not is_accepted


def test_command_runs_and_restarts(gpu, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    box = write_lattice(tmp_path / "box.pdb")
    every = ("--every", "0.01", "--report-every", "0.01")
    run("run", box, "--platform", "Reference", "--steps", "5", "--dt", "2", "--equilibrate", "0.2", *every)
    run("run", box, "--platform", gpu, "--steps", "15", "--restart", "box.chk")
    assert f"on the {gpu} platform" in capsys.readouterr().out
    rows = log(tmp_path / "box.csv")
    assert rows["Step"].tolist() == [0, 5, 10, 15]
    # 27 molecules have some 200 kJ/mol of kinetic energy, of which 1e-3 is lost at 2 fs with SIER4.
    assert np.ptp(rows["Total Energy (kJ/mole)"]) < 0.5


def test_mixed_precision_is_a_property_of_one_context(gpu):
    """Others keep the default of the platform."""
    chosen, system = platform(gpu), assembled([1.0])
    usual = chosen.getPropertyDefaultValue("Precision")
    context = make_context(system, openmm.VerletIntegrator(0.001), gpu)
    assert chosen.getPropertyValue(context, "Precision") == "mixed"
    assert chosen.getPropertyDefaultValue("Precision") == usual != "mixed"


@pytest.fixture(scope="module")
def framed():
    """Two domains, benzene and carbon dioxide with frames, and their phase point at 300 K."""
    system, positions, bodies = system_of("36 beads", "benzene", "36 beads", "carbon dioxide", apart=2.2)
    system.addForce(polar(system, bodies, charge=0.4))
    framed = with_frames(system, moved(positions, bodies), bodies)
    context = openmm.Context(framed.system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(framed.positions)
    context.setVelocitiesToTemperature(300, 4)
    return framed, phase_point(context), bodies


def test_bodies_with_frames_move_as_on_reference(gpu, framed):
    """By Verlet; forces of mixed precision are good to 1e-6, and SETTLE, which holds benzene, to 5e-9 nm."""
    made, point, _ = framed
    results = []
    for name in ("Reference", gpu):
        integrator = openmm.VerletIntegrator(0.001)
        integrator.setConstraintTolerance(1e-7)
        if name == gpu:
            context = gpu_context(gpu, "mixed", made.system, integrator, point)
        else:
            context = context_at(made.system, integrator, point)
        integrator.step(200)
        results.append(made.getAtomPositions(context.getState(positions=True)))
    assert np.abs(results[0] - point[0][: made.numAtoms]).max() > 0.02
    assert np.abs(results[1] - results[0]).max() < 2e-6


def test_bodies_with_frames_in_a_bath_and_under_pressure(gpu, framed):
    made, point, bodies = framed
    system = openmm.XmlSerializer.clone(made.system)
    system.setDefaultPeriodicBoxVectors([12, 0, 0], [0, 12, 0], [0, 0, 12])
    system.getForce(0).setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    system.addForce(seeded(openmm.MonteCarloBarostat(50.0, 300, 5), 3))
    integrator = seeded(openmm.LangevinMiddleIntegrator(300, 20.0, 0.004), 2)
    context = gpu_context(gpu, "mixed", system, integrator, point)
    kinetic, volumes = [], set()
    for _ in range(60):
        integrator.step(20)
        state = context.getState(energy=True)
        kinetic.append(state.getKineticEnergy()._value)
        volumes.add(state.getPeriodicBoxVolume()._value)
    # Of 240 moves.
    assert len(volumes) > 1
    # 23 freedoms; the bath makes samples independent, so that the mean is good to sqrt(2/(23 60)).
    assert np.mean(kinetic) == pytest.approx(23 / 2 * GAS_CONSTANT * 300, rel=6.5 * math.sqrt(2 / (23 * 60)))
    x = made.getAtomPositions(context.getState(positions=True))
    for atoms in bodies[:3]:
        shapes = [np.linalg.norm(each[atoms][:, None] - each[atoms][None], axis=2) for each in (x, point[0])]
        # Axes and centres of single precision, 6e-8 of 10 nm.
        assert np.abs(shapes[0] - shapes[1]).max() < 5e-6


def test_kinetic_energies_of_massless_sites(gpu):
    """OpenMM uploads global variables only in steps of its own, which the exact engine does not make."""
    system, positions, bodies = typed({PATCHY: 5})
    integrator = SIERIntegrator(0.01, bodies=bodies, engine="exact")
    context = make_context(system, integrator, gpu)
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, 1)
    for _ in range(2):
        kinetic = context.getState(energy=True).getKineticEnergy()._value
        # Velocities in mixed precision.
        assert kinetic == pytest.approx(sum(bodies.kinetic_energies(integrator.getBodyState())), rel=1e-5)
        integrator.step(2)
