"""Programs after the tasks of OpenMM's cookbook, with these integrators in place of its own and steps as they are."""

import copy

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIERIntegrator, SIERLangevinIntegrator
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.silence import silence
from tests.support.waters import array, force_of, phase_point, plain_context, platform

KELVIN, PICOSECOND, FEMTOSECOND = unit.kelvin, unit.picosecond, unit.femtosecond
ENGINES = ("exact", "native")


def langevin(engine="auto", step=4 * FEMTOSECOND):
    """In place of LangevinMiddleIntegrator(300*kelvin, 1/picosecond, 0.004*picoseconds)."""
    return SIERLangevinIntegrator(300 * KELVIN, 1 / PICOSECOND, step, engine=engine)


def simulation_with(topology, system, integrator, positions):
    simulation = app.Simulation(topology, system, integrator, platform())
    simulation.context.setPositions(positions)
    return simulation


@pytest.fixture(scope="module")
def chain():
    """Topology and positions of a peptide in vacuum."""
    return capped_alanine_box(0)


@pytest.fixture
def held(chain):
    """The peptide with bonds to hydrogen constrained."""
    return forcefield().createSystem(chain[0], constraints=app.HBonds)


def is_sound(simulation):
    positions, velocities = phase_point(simulation.context)
    return bool(np.isfinite(positions).all() and np.isfinite(velocities).all())


# --- Contexts for energies alone ---


@pytest.mark.parametrize("engine", ENGINES)
def test_energies_of_a_flexible_molecule_by_force_group(chain, engine):
    """Its step of 4 fs is never made, and only a call of `step` refuses it. Minimization needs none either."""
    topology, positions = chain
    system = forcefield().createSystem(topology)
    for number, force in enumerate(system.getForces()):
        force.setForceGroup(number)
    with silence():
        simulation = simulation_with(topology, system, langevin(engine), positions)
    stock = plain_context(system, positions)
    for number in range(system.getNumForces()):
        results, expected = (
            context.getState(energy=True, groups={number}).getPotentialEnergy()
            for context in (simulation.context, stock)
        )
        assert results == expected
    with silence():
        simulation.minimizeEnergy(maxIterations=5)
        simulation.context.setVelocitiesToTemperature(300, 1)
        simulation.context.reinitialize(preserveState=True)
        temperature = simulation.integrator.computeSystemTemperature()
    assert temperature > 0 * KELVIN
    before = phase_point(simulation.context)
    with pytest.raises(openmm.OpenMMException, match="4 fs is too long: the bond"):
        simulation.step(1)
    assert simulation.context.getStepCount() == 0
    np.testing.assert_array_equal(phase_point(simulation.context), before)
    simulation.integrator.setStepSize(1 * FEMTOSECOND)
    with silence():
        simulation.step(1)


@pytest.mark.parametrize("engine", ENGINES)
def test_interaction_energies_by_scaled_parameters(engine):
    """Charges and depths of peptide and water as offsets, which Context parameters switch off; Verlet's 1 fs."""
    topology, positions = capped_alanine_box(12)
    system = forcefield().createSystem(topology, rigidWater=False)
    chain = {atom.index for atom in topology.atoms() if atom.residue.name != "HOH"}
    force = force_of(system)
    for name in ("solute", "solvent"):
        force.addGlobalParameter(name, 1)
    for i in range(force.getNumParticles()):
        parameters = force.getParticleParameters(i)
        force.setParticleParameters(i, 0, 0, 0)
        force.addParticleParameterOffset("solute" if i in chain else "solvent", i, *parameters)
    for i in range(force.getNumExceptions()):
        first, second, *_ = force.getExceptionParameters(i)
        force.setExceptionParameters(i, first, second, 0, 0, 0)
    force.setForceGroup(1)
    with silence():
        context = openmm.Context(system, SIERIntegrator(1 * FEMTOSECOND, engine=engine), platform())
    contexts = context, plain_context(system, positions)
    context.setPositions(positions)
    results = []
    for each in contexts:
        energies = []
        for solute, solvent in ((1, 1), (1, 0), (0, 1)):
            each.setParameter("solute", solute)
            each.setParameter("solvent", solvent)
            energies.append(each.getState(energy=True, groups={1}).getPotentialEnergy()._value)
        results.append(energies[0] - energies[1] - energies[2])
    assert results[0] == results[1] != 0


# --- forces that are added, and changed in a run ---


def pulled(held, positions):
    """A constant force on two atoms."""
    force = openmm.CustomExternalForce("-fx*x-fy*y-fz*z")
    for name in ("fx", "fy", "fz"):
        force.addPerParticleParameter(name)
    force.addParticle(0, (-10, 0, 0) * unit.kilojoules_per_mole / unit.nanometer)
    force.addParticle(len(positions) - 1, (10, 0, 0) * unit.kilojoules_per_mole / unit.nanometer)
    return force, lambda: force.setParticleParameters(0, 0, (-20, 0, 0))


def pinned(held, positions):
    """Carbons at their places by a restraint."""
    force = openmm.CustomExternalForce("k*periodicdistance(x, y, z, x0, y0, z0)^2")
    force.addGlobalParameter("k", 100.0)
    for name in ("x0", "y0", "z0"):
        force.addPerParticleParameter(name)
    carbons = [i for i in range(len(positions)) if 11 < held.getParticleMass(i)._value < 13]
    for i in carbons:
        force.addParticle(i, positions[i])
    return force, lambda: force.setParticleParameters(0, carbons[0], positions[carbons[0]] + [0.1, 0, 0])


def turned(held, positions):
    """A dihedral held by a torsion."""
    force = openmm.PeriodicTorsionForce()
    force.addTorsion(4, 6, 8, 14, 1, 0 * unit.radians, 100 * unit.kilojoules_per_mole)
    return force, lambda: force.setTorsionParameters(0, 4, 6, 8, 14, 1, 0.1, 100)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("make", [pulled, pinned, turned])
def test_restraints_and_external_forces(chain, held, make, engine):
    """4 fs draw no warning except about the start; changes during a run act from the next step on."""
    topology, positions = chain
    force, change = make(held, positions)
    held.addForce(force)
    with silence(r"\d+ of \d+ bodies do not quite"):
        simulation = simulation_with(topology, held, langevin(engine), positions)
        simulation.step(5)
        change()
        force.updateParametersInContext(simulation.context)
        simulation.step(5)
    assert simulation.currentStep == 10
    assert is_sound(simulation)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_distance_is_pulled_by_a_collective_variable(chain, held, engine):
    """Steered dynamics: the Force is added to a Context that has run, and its parameter moved every few steps."""
    topology, positions = chain
    with silence(r"\d+ of \d+ bodies do not quite"):
        simulation = simulation_with(topology, held, langevin(engine), positions)
        simulation.context.setVelocitiesToTemperature(300 * KELVIN, 1)
        simulation.step(5)
        distance = openmm.CustomBondForce("r")
        distance.addBond(1, len(positions) - 1)
        pulling = openmm.CustomCVForce("0.5 * fc_pull * (cv-r0)^2")
        pulling.addGlobalParameter("fc_pull", 1000.0)
        pulling.addGlobalParameter("r0", 1.0)
        pulling.addCollectiveVariable("cv", distance)
        held.addForce(pulling)
        simulation.context.reinitialize(preserveState=True)
        for shift in range(3):
            simulation.context.setParameter("r0", 1.0 + 0.01 * shift)
            simulation.step(5)
    assert simulation.context.getStepCount() == 20
    assert len(pulling.getCollectiveVariableValues(simulation.context)) == 1


@pytest.mark.parametrize("engine", ENGINES)
def test_atoms_are_held_by_having_no_mass(engine):
    topology, positions = capped_alanine_box(6)
    system = forcefield().createSystem(topology, constraints=app.HBonds)
    frozen = [atom.index for atom in topology.atoms() if atom.residue.name != "HOH"]
    for i in frozen:
        system.setParticleMass(i, 0 * unit.dalton)
    with silence(r"\d+ of \d+ bodies do not quite"):
        simulation = simulation_with(topology, system, langevin(engine), positions)
        simulation.step(5)
    after, _ = phase_point(simulation.context)
    np.testing.assert_array_equal(after[frozen], positions[frozen])
    assert np.abs(after - positions).max() > 0


# --- temperature, pressure and hydrogen masses ---


@pytest.mark.parametrize("engine", ENGINES)
def test_temperature_and_pressure_are_changed_in_a_run(engine):
    """The barostat is added to a Context that has run; both temperatures are set together."""
    topology, positions = copy.deepcopy(capped_alanine_box(30))
    topology.setPeriodicBoxVectors(2.2 * np.eye(3) * unit.nanometer)
    system = forcefield().createSystem(
        topology, nonbondedMethod=app.PME, nonbondedCutoff=1 * unit.nanometer, constraints=app.HBonds
    )
    with silence(r"\d+ of \d+ bodies do not quite"):
        integrator = langevin(engine)
        simulation = simulation_with(topology, system, integrator, positions)
        integrator.step(2)
        integrator.setTemperature(280 * KELVIN)
        integrator.step(2)
        # Its temperature is set before the next step is made.
        system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, 300 * KELVIN, 1))
        simulation.context.reinitialize(preserveState=True)
        for temperature in (300 * KELVIN, 270 * KELVIN):
            simulation.context.setParameter(openmm.MonteCarloBarostat.Temperature(), temperature)
            integrator.setTemperature(temperature)
            integrator.step(2)
        simulation.context.setParameter(openmm.MonteCarloBarostat.Pressure(), 0.5 * unit.bar)
        integrator.step(2)
    assert simulation.context.getStepCount() == 10
    assert is_sound(simulation)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_drift_at_several_steps_with_heavier_hydrogens(chain, step):
    """Verlet's steps of 1, 2 and 4 fs, with hydrogens of 1.5 dalton that constraints hold."""
    topology, positions = chain
    system = forcefield().createSystem(topology, constraints=app.HBonds, hydrogenMass=1.5 * unit.dalton)
    with silence(
        r"\d+ of \d+ bodies do not quite", r"With steps of 4 fs the total energy wanders", "A step of 4 fs is long"
    ):
        simulation = simulation_with(topology, system, SIERIntegrator(step * FEMTOSECOND), positions)
        simulation.context.setVelocitiesToTemperature(300 * KELVIN, 1)
        simulation.step(10)
    assert is_sound(simulation)


# --- models of beads ---


def beads(n=20):
    """A chain of beads with Lennard-Jones forces that are an expression, of 10 fs in the tutorial on polymers."""
    bonds = openmm.HarmonicBondForce()
    pairs = openmm.CustomNonbondedForce("4*epsilon*((sigma/r)^12-(sigma/r)^6); sigma=0.5; epsilon=1")
    pairs.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    pairs.setCutoffDistance(1.5)
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(10 * np.eye(3)))
    for i in range(n):
        system.addParticle(100)
        pairs.addParticle([])
        if i:
            bonds.addBond(i - 1, i, 0.38, 1000)
    pairs.createExclusionsFromBonds([(i, i + 1) for i in range(n - 1)], 1)
    system.addForce(bonds)
    system.addForce(pairs)
    return system, np.array([[0.38 * i, 0.19 * (-1) ** i, 0] for i in range(n)])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_polymer_of_beads(engine):
    system, positions = beads()
    integrator = SIERLangevinIntegrator(300 * KELVIN, 0.01 / PICOSECOND, 0.010 * PICOSECOND, engine=engine)
    with silence():
        context = openmm.Context(system, integrator, platform())
        context.setPositions(positions)
        integrator.step(10)
        system.addForce(openmm.MonteCarloBarostat(1.0 * unit.bar, 300 * KELVIN))
        context.reinitialize(preserveState=True)
        integrator.step(10)
    assert np.isfinite(array(context.getState(positions=True).getPositions(asNumpy=True))).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_tabulated_interactions_by_type(engine):
    """Particles of two types whose potential is a table over both types and the distance; no step of its own."""
    r = np.linspace(0, 1.2, 61)
    near = 5 * (1 - r / 1.2) ** 2
    values = np.array([[near, 2 * near], [2 * near, near]]).flatten(order="F")
    force = openmm.CustomNonbondedForce("table(type1, type2, r)")
    force.addTabulatedFunction("table", openmm.Continuous3DFunction(2, 2, len(r), values, 0, 1, 0, 1, 0, 1.2))
    force.addPerParticleParameter("type")
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffNonPeriodic)
    force.setCutoffDistance(1.2)
    system = openmm.System()
    for i in range(8):
        system.addParticle(40)
        force.addParticle([i % 2])
    system.addForce(force)
    positions = 0.5 * np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)
    with silence():
        context = openmm.Context(system, langevin(engine), platform())
        context.setPositions(positions)
        context.getIntegrator().step(5)
    assert context.getStepCount() == 5
