"""The start of a run: settled, at the temperature, with the energy that keeps it there."""

import math

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER4G,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.inputs import equilibration, forcefields
from openmm_sier.inputs.equilibration import EquilibrationWarning, equilibrate, prepare
from tests.support import flexible_waters
from tests.support.commands import write_lattice
from tests.support.reports import RecordingReport
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.systems import assembled, field, with_forces
from tests.support.waters import energies, phase_point, platform
from tests.support.waters_in_fields import falling_water, tethered_water

TEMPERATURE = 300.0


def context_of(system, positions, integrator=None):
    context = openmm.Context(system, integrator or SIERIntegrator(0.001, "SIER2"), platform())
    context.setPositions(positions)
    return context


@pytest.fixture(scope="module")
def tethered():
    return tethered_water(60)


def test_it_ends_when_temperatures_and_potential_energy_have_settled(tethered):
    """From springs at rest: half of the energy has still to come when the bath has the temperature already."""
    report = RecordingReport()
    outcome = equilibrate(context_of(*tethered), TEMPERATURE, report=report)
    # One in a hundred windows is out of bounds by chance, so that 17 of them are so with a probability of 1e-34.
    assert outcome.settled
    assert 3 <= outcome.time < equilibration.LONGEST
    # 180 degrees of freedom each: the bounds, within which what has settled is.
    bound = TEMPERATURE * math.sqrt(2 / 180)
    assert abs(outcome.means.translation - TEMPERATURE) < bound
    assert abs(outcome.means.rotation - TEMPERATURE) < bound
    # 360 springs with kT/2 each, whose sum is known over 2 ps to 3.3 % (a correlation time of 0.2 ps). Seven times that
    # has a probability of 1e-11.
    thermal = 180 * GAS_CONSTANT * TEMPERATURE
    assert outcome.means.potential == pytest.approx(thermal, rel=7 * math.sqrt(2 / 360 / 5))
    (note,) = report.notes
    assert "not settled" not in note
    ((_, fractions),) = report.runs
    assert fractions == sorted(fractions)


def test_a_potential_energy_that_is_still_falling_has_not_settled(monkeypatch):
    """80 waters fall at their terminal velocity, g over the friction of 5/ps, 0.15 nm/ps.

    Translations are warmer by m v^2/3R = 16 K, within the bound of 27 K, but 160 kJ/mol of potential energy a ps go to
    the bath, where two standard deviations of the kinetic energy are 77 kJ/mol.
    """
    monkeypatch.setattr(equilibration, "LONGEST", 4.0)
    with pytest.warns(EquilibrationWarning, match="after 4"):
        outcome = equilibrate(context_of(*falling_water(80, 0.75)), TEMPERATURE)
    assert not outcome.settled
    assert abs(outcome.means.translation - TEMPERATURE) < TEMPERATURE * math.sqrt(2 / 240)


def test_a_temperature_that_is_not_reached_is_not_settled(monkeypatch, tethered):
    monkeypatch.setattr(equilibration, "LONGEST", 4.0)
    system = with_forces(tethered[0], seeded(openmm.AndersenThermostat(2 * TEMPERATURE, 50), 1))
    with pytest.warns(EquilibrationWarning, match="out of bounds"):
        outcome = equilibrate(context_of(system, tethered[1]), TEMPERATURE)
    assert not outcome.settled


@pytest.mark.parametrize("time", [0.0, 0.06])
def test_a_time_that_is_given_is_kept(tethered, time):
    report = RecordingReport()
    equilibration = equilibrate(context_of(*tethered), TEMPERATURE, time=time, report=report)
    assert equilibration.time == pytest.approx(time)
    assert not equilibration.settled
    # Springs at rest take up half of the heat in 0.06 ps.
    assert equilibration.doubtful == bool(time)
    assert len(report.notes) == bool(time)
    assert all(note.endswith("not settled") for note in report.notes)


def test_the_context_is_equilibrated(tethered, monkeypatch):
    """It gets the atoms of the heat bath, and keeps its own time."""
    system, positions = tethered
    context = context_of(system, positions, SIERHMCIntegrator(TEMPERATURE, 0.001))
    context.setTime(2.0)
    context.setStepCount(7)
    make, baths = equilibration._bath_context, []

    def kept(*arguments):
        baths.append(make(*arguments))
        return baths[0]

    monkeypatch.setattr(equilibration, "_bath_context", kept)
    equilibrate(context, TEMPERATURE, time=0.06)
    np.testing.assert_array_equal(phase_point(context), phase_point(baths[0]))
    # At 300 K a molecule of water moves by 0.02 nm in 0.06 ps.
    assert np.abs(phase_point(context)[0] - positions).max() > 1e-3
    assert context.getTime() == 2.0 * unit.picosecond
    assert context.getStepCount() == 7


def test_a_context_whose_equilibration_fails_stays_as_it_was(tethered, monkeypatch):
    context = context_of(*tethered)

    def fail(*_):
        raise openmm.OpenMMException("Particle coordinate is NaN")

    monkeypatch.setattr(equilibration, "_window", fail)
    before = np.array(phase_point(context))
    with pytest.raises(openmm.OpenMMException, match="is NaN"):
        equilibrate(context, TEMPERATURE)
    assert np.array_equal(before, np.array(phase_point(context)))


def test_only_contexts_of_this_package_are_equilibrated(tethered):
    context = context_of(*tethered, openmm.VerletIntegrator(0.001))
    with pytest.raises(TypeError, match="got a VerletIntegrator"):
        equilibrate(context, TEMPERATURE)


@pytest.mark.parametrize("fast", [False, True])
def test_the_step_follows_the_bonds(fast):
    """Springs with a period of 11.6 fs: SIER4G follows them at 4.2 fs, and kicks should come twice in it, or more often
    where the charges are an eighth as stiff as the springs."""
    system, positions = flexible_waters.system_of(2)
    groups = prepare_system(system).fastForceGroups if fast else None
    report = RecordingReport()
    with silence():
        context = context_of(system, positions, SIERIntegrator(0.002, fastForceGroups=groups))
        equilibration = equilibrate(context, TEMPERATURE, time=0.05, report=report)
    period = 2 * math.pi * math.sqrt(1 / (flexible_waters.BOND * (1 / 1.008 + 1 / 15.999)))
    step = 0.75 * (0.4365 * period if fast else SIER4G.accuracy_limit * period / (2 * math.pi))
    assert f"equilibrates in steps of {1000 * step:.2g} fs" in report.notes[0]
    assert equilibration.time == pytest.approx(round(0.05 / step) * step, rel=1e-3)
    # Bonds in the kicks are followed to a few per cent. Velocities are drawn: 12 degrees of freedom, four deviations.
    assert 0 < equilibration.means.flexible < TEMPERATURE * (1 + 4 * math.sqrt(2 / 12))


def test_without_an_equilibration_velocities_are_drawn(tethered):
    context = context_of(*tethered)
    prepare(context, tethered[1] * unit.nanometer, TEMPERATURE, time=0)
    # 360 degrees of freedom, 7 % of scatter; four times that.
    assert context.getIntegrator().computeTemperatures().in_kelvin().total == pytest.approx(TEMPERATURE, rel=0.3)


def test_it_is_decided_by_the_seed(tethered):
    ends = []
    for seed in (1, 1, 2):
        context = context_of(*tethered)
        prepare(context, tethered[1] * unit.nanometer, TEMPERATURE, seed, time=0.06)
        ends.append(np.array(phase_point(context)))
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


def test_energy_of_a_run_at_constant_energy_is_the_mean_of_the_equilibration(tethered):
    """Mean potential energy, and kT/2 for each of the 360 degrees of freedom, which springs leave all of them."""
    context, snapshot = context_of(*tethered), context_of(*tethered)
    equilibration = equilibrate(snapshot, TEMPERATURE)
    prepare(context, tethered[1] * unit.nanometer, TEMPERATURE)
    expected = equilibration.means.potential + 180 * GAS_CONSTANT * TEMPERATURE
    assert sum(energies(context)) == pytest.approx(expected, rel=1e-9)
    # A snapshot of the bath has another energy, which is what this is for.
    assert sum(energies(snapshot)) != pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
def test_a_run_with_a_bath_starts_from_the_snapshot(tethered):
    context, snapshot = (context_of(*tethered, SIERLangevinIntegrator(TEMPERATURE, 1.0, 0.001)) for _ in range(2))
    equilibrate(snapshot, TEMPERATURE)
    prepare(context, tethered[1] * unit.nanometer, TEMPERATURE)
    _, velocities = phase_point(context)
    _, expected = phase_point(snapshot)
    masses = np.array([tethered[0].getParticleMass(i)._value for i in range(len(expected))])
    # But for the motion of the centre of mass, and the rounding of a fit to rigid bodies.
    np.testing.assert_allclose(velocities, expected - masses @ expected / masses.sum(), atol=1e-12)
    assert np.abs(masses @ velocities).max() < 1e-10


def test_start_at_constant_pressure_has_the_box_of_its_equilibration(tmp_path, monkeypatch):
    """Positions and volume at the end of the equilibration are those at the start of the run."""
    box = forcefields.read_box(write_lattice(tmp_path / "box.pdb"))
    window = equilibration._window

    def growing(bath, *arguments):
        """As a barostat makes the box grow, which none would do for certain."""
        means = window(bath, *arguments)
        bath.setPeriodicBoxVectors(*(1.01 * bath.getState().getPeriodicBoxVectors(asNumpy=True)))
        return means

    monkeypatch.setattr(equilibration, "_window", growing)
    context, other = (
        equilibration.make_context(box.system, SIERIntegrator(0.001, "SIER2"), "Reference") for _ in range(2)
    )
    initial = context.getState().getPeriodicBoxVolume()
    other.setPositions(box.positions)
    other.computeVirtualSites()
    other.applyConstraints(1e-6)
    equilibrate(other, 297.0, time=0.1)
    prepare(context, box.positions, 297.0, time=0.1, minimize=False)
    end, state = (each.getState(positions=True) for each in (other, context))
    assert state.getPeriodicBoxVolume() == end.getPeriodicBoxVolume()
    assert state.getPeriodicBoxVolume() / initial == pytest.approx(1.01**3, rel=1e-12)
    # Positions are fitted to rigid bodies, which rounds them.
    positions, expected = (s.getPositions(asNumpy=True)._value for s in (state, end))
    assert np.abs(positions - expected).max() < 1e-14


def test_threads_are_no_more_than_the_cores_of_the_process(monkeypatch):
    """OpenMM counts those of the machine; who has set fewer keeps them."""
    cpu = platform("CPU")
    usual = cpu.getPropertyDefaultValue("Threads")
    monkeypatch.setattr(equilibration, "cores", lambda: 2)
    try:
        for default, results in (("3", "2"), ("1", "1")):
            cpu.setPropertyDefaultValue("Threads", default)
            context = equilibration.make_context(flexible_waters.system_of(1)[0], openmm.VerletIntegrator(0.001), "CPU")
            assert cpu.getPropertyValue(context, "Threads") == results
            assert cpu.getPropertyDefaultValue("Threads") == default
    finally:
        cpu.setPropertyDefaultValue("Threads", usual)


def test_the_force_that_calls_for_a_minimization_does_not_grow_with_a_molecule():
    """On molecules of 100 atoms, in one field for all: 100 times the force on an atom, over the root of 100."""
    bonds = openmm.HarmonicBondForce()
    for i in range(200):
        if i % 100:
            bonds.addBond(i - 1, i, 0.15, 0.0)
    system = assembled(200 * [12.0], bonds, field("-7*x", range(200)))
    line = np.arange(200)[:, None] * [0.15, 0.0, 0.0]
    assert equilibration._strongest_force(context_of(system, line)) == pytest.approx(70.0)
